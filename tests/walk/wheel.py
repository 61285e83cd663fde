"""The built wheel works on its own: unpacked into an empty folder, it runs and its kernels load from there."""

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

CODE = """
import sys; sys.path.insert(0, sys.argv[1])
from spikerig import _native
import spikerig.dataset.cli as cli, spikerig.rigctl.sim, spikerig.train, spikerig.calib
assert _native.__file__.startswith(sys.argv[1]), _native.__file__
assert cli.__file__.startswith(sys.argv[1]), cli.__file__
print("wheel:", _native.isa(), sorted(_native.isas()))
"""


def main(wheel: Path) -> int:
    """Unpack `wheel` and run from it; the exit status of that run."""
    with tempfile.TemporaryDirectory() as folder:
        with zipfile.ZipFile(wheel) as packed:
            names = packed.namelist()
            packed.extractall(folder)
        wrong = [n for n in names if n.startswith(("tests/", "docs/", "native/")) or n.endswith((".cpp", ".o"))]
        if wrong:
            print("the wheel holds what it should not:", wrong[:5])
            return 1
        code = subprocess.run([sys.executable, "-I", "-c", CODE, folder], cwd=folder, check=False).returncode
        if code == 0:
            print("1 passed, 0 failed")
        return code


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
