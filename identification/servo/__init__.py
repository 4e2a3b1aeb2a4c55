"""Position servos with friction, identified from commanded and measured positions alone."""
