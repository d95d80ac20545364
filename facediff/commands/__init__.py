"""The subcommands: one module each, with ``run(name, arguments) -> exit status``."""
