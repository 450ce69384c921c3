"""Object class, orientation and position from class labels in MCAP logs."""

__version__ = "0.1.0"
