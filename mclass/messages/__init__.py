"""Message definitions and their encodings."""
