"""Nothing is left to compile once the ports are open."""

import json
import subprocess
import sys

PROGRAM = """
import json, sys
import numba
import estimator, mapper.kernel, mapper.projection
from service.commands.virtual_drive import drive_virtually
from service.config import load
from service.rehearsal import rehearse
from service.shipped import shipped_config

def compiled():
    return {
        f"{name}.{key}": len(value.signatures)
        for name, module in list(sys.modules.items()) if name.split(".")[0] in ("estimator", "mapper")
        for key, value in vars(module).items() if isinstance(value, numba.core.dispatcher.Dispatcher)
        and name != "mapper.tile"  # the publisher's, which sees to them itself
    }

demo = load(shipped_config("demo.toml"))
rehearse(demo.config)
before = compiled()
drive_virtually(demo, scene="yard", law="corners", seed=1, duration_s=6.0)
print(json.dumps([name for name, count in compiled().items() if count != before[name]]))
"""


def test_a_rehearsal_leaves_nothing_to_compile() -> None:
    """A drive after it makes no new machine code in filter and kernel: no read ever waits for the compiler."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=200, check=True)
    assert json.loads(done.stdout) == []
