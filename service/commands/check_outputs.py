"""What the service is to write and where it is to listen, tried before a drive: it would run without them, and tell."""

import getpass
from datetime import UTC, datetime

from drivers.errors import LinkError
from service.commands.run import unused_path
from service.config import LoadedConfig
from service.output_files import OutputError, refuse_unwritable
from service.session import open_session


def output_problems(loaded: LoadedConfig) -> list[str]:
    """A line for each file that can't be written and each address that can't be listened at. Nothing is left behind."""
    return _file_problems(loaded) + _address_problems(loaded)


def _file_problems(loaded: LoadedConfig) -> list[str]:
    config, problems = loaded.config, []
    wanted = {"record.path": config.record.path, "store.path": config.store.path, "store.map": config.store.map}
    for key, name in wanted.items():
        if name is None:
            continue
        path = loaded.path(name)
        try:
            refuse_unwritable([unused_path(path, datetime.now(UTC)) if key == "record.path" else path])
        except OutputError as error:
            problems.append(f"{key}: {error} (as the user {_user()}, who runs this check)")
    return problems


def _address_problems(loaded: LoadedConfig) -> list[str]:
    try:
        with open_session("peer", loaded.config.publish.listen):
            return []
    except LinkError as error:
        return [f"publish.listen: {error} (a service that runs already listens there: stop it for this check)"]


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user id without a name
        return "without a name"
