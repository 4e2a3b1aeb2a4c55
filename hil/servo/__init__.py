"""Arms without torque: servo and friction of each joint from commanded and measured positions."""
