"""Files that come with terrabound: example configurations, found in a checkout and in an installation alike."""

from pathlib import Path

from drivers.errors import ConfigurationError

_SERVICE = Path(__file__).resolve().parent


def shipped_config(name: str) -> Path:
    """Path of docs/config/`name`."""
    for folder in (_SERVICE.parent / "docs" / "config", _SERVICE / "shipped_config"):
        if (folder / name).exists():
            return folder / name
    raise ConfigurationError(f"{name}: this installation lacks its example configuration; install terrabound again")
