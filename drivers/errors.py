"""One error tree. Line dirt is never an exception: it is a counted event inside a protocol.

TerraboundError
├── ConfigurationError      a key, its value, and how to mend it       (exit code 78)
├── PortError               a device port that can't be used now       (retried, or exit code 1)
│   ├── PortMissing         no such port
│   ├── PortBusy            somebody else has it open
│   └── PortLost            it went away while in use (unplugged)
├── CaptureError            a recording that can't be read or written
└── LinkError               the network session can't be opened
"""


class TerraboundError(Exception):
    """Something a person can act on; the text says which thing, what was found, and what to do."""


class ConfigurationError(TerraboundError):
    """The configuration is wrong."""


class PortError(TerraboundError):
    """A device port can't be used."""


class PortMissing(PortError):
    """No such port."""


class PortBusy(PortError):
    """Another process has the port open."""


class PortLost(PortError):
    """The port went away while in use."""


class CaptureError(TerraboundError):
    """A recording can't be read or written."""


class LinkError(TerraboundError):
    """The network session can't be opened."""
