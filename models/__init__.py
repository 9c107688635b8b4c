"""Generative programs: each a short file to copy and edit."""
