"""Results as channels of a log, and back: everything under ``/mclass``."""
