"""Worlds that models invent recordings from."""
