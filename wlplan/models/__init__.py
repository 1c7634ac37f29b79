"""Learned models of loading performance and pile state. Paper, sections 3.4 and 3.5."""
