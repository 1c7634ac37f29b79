"""Piles on a grid and everything that changes them."""
