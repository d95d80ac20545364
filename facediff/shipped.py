"""Where the shipped configs are: inside an installed package, beside it in a checkout."""

from pathlib import Path


def config_dir() -> Path:
    """The folder that holds ``experiment/``, ``model/``, ``data/`` and ``trainer/``."""
    inside = Path(__file__).parent / "configs"
    return inside if inside.is_dir() else Path(__file__).parent.parent / "configs"
