"""Planners, one a file."""
