"""Choices made by the data: settings, essential parameters."""
