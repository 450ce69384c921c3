"""Many logs at once: what to do, who does it, and the record of what came of it."""
