"""What the tests of the whole line share."""

import pytest

from service.commands.port_drive import PortDrive, drive_on_ports


@pytest.fixture(scope="session")
def port_drive(tmp_path_factory: pytest.TempPathFactory) -> PortDrive:
    """One short drive through real pseudo-terminals, with its capture, map, poses and truth."""
    return drive_on_ports(tmp_path_factory.mktemp("drive"), scene="stairs", law="corners", seed=3, duration_s=8.0)
