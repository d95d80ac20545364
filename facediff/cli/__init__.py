"""The command line: one module per subcommand."""

from facediff.cli.app import main

__all__ = ["main"]
