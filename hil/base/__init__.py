"""What every floor uses and nothing of a robot: errors, files, text, progress, threads."""
