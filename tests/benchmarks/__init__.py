"""Speed and memory, side by side with what else could be used. See ``__main__``."""
