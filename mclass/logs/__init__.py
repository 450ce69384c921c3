"""MCAP logs in and out; nothing outside this package knows the file format."""
