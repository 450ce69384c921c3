"""Estimates against the truth: who is who, how far off, and how honest about it."""
