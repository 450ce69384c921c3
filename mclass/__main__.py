"""``python -m mclass`` is ``mclass``."""

from mclass.commands.cli import main

main(prog_name="mclass")
