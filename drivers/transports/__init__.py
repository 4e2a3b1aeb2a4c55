"""Links that move bytes and time, nothing else."""
