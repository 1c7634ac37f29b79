"""Worlds: what they say they can do, the learned ones, and all of them by name."""
