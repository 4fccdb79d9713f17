"""The script of `make bench` can be started."""

import subprocess
import sys
from pathlib import Path


def test_the_script_starts():
    script = Path(__file__).with_name("run.py")
    done = subprocess.run([sys.executable, str(script), "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--update" in done.stdout
