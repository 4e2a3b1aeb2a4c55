"""The settings each method comes with, as files for people."""
