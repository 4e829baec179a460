#!/usr/bin/env python3
"""Makes a virtual environment with the given packages in the user's cache folder, once, and prints
its interpreter.

    python3 scripts/python_env.py NAME PACKAGE==VERSION ...

Only tests use it, to compare with other programs. It ends with an error when the packages are not
there yet and cannot be fetched; the tests then say that they were skipped.
"""

import fcntl
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path


def main() -> int:
    name, packages = sys.argv[1], sorted(sys.argv[2:])
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "planesweep"
    place = cache / f"python-{name}"
    interpreter, done = place / "bin" / "python", place / "installed.txt"
    wanted = "\n".join(packages)
    cache.mkdir(parents=True, exist_ok=True)
    with open(cache / f"python-{name}.lock", "w") as lock:
        # Several tests may ask at the same time.
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (done.is_file() and done.read_text() == wanted):
            shutil.rmtree(place, ignore_errors=True)
            venv.create(place, with_pip=True)
            command = [interpreter, "-m", "pip", "install", "--quiet", "--only-binary=:all:"]
            command += ["--disable-pip-version-check", "--retries", "1", "--timeout", "15", *packages]
            if subprocess.run(command, stdout=sys.stderr).returncode != 0:
                shutil.rmtree(place, ignore_errors=True)
                return 1
            done.write_text(wanted)
    print(interpreter)
    return 0


if __name__ == "__main__":
    sys.exit(main())
