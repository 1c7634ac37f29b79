"""Learned models of loading performance and pile state. Paper, sections 4.4 and 4.5."""
