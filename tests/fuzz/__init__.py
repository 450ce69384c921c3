"""Fuzzing: targets, inputs to start from, and inputs that once went wrong."""
