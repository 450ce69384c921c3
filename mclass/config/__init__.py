"""Model files: YAML with line numbers to checked dataclasses."""
