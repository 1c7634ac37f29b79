"""Worlds by name."""
