"""Files of an identified arm for simulators, read back."""
