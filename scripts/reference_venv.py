"""Makes a virtual environment with the given packages in the user's cache folder and prints its interpreter.

    python3 scripts/reference_venv.py open3d-cpu==0.19.0 numpy==2.2.6

Called by the tests that compare with other software. The environment is made once per list of packages,
without their dependencies, and is complete or absent. Only the standard library is used. Exit status 1
and a line on stderr say that the packages cannot be installed here.
"""

import fcntl
import hashlib
import os
import pathlib
import shutil
import subprocess
import sys
import venv


def cache_folder():
    root = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(root) / "planesweep"


def interpreter(folder):
    return folder / "bin" / "python"


def install(requirements, folder):
    venv.create(folder, with_pip=True)
    command = [interpreter(folder), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    # Without a network, say so soon.
    command += ["--no-deps", "--only-binary=:all:", "--retries", "1", "--timeout", "15"]
    done = subprocess.run(command + requirements, stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or ["no reason given"]
        raise OSError(f"pip cannot install {' '.join(requirements)}: {last[0]}")


def main():
    requirements = sorted(sys.argv[1:])
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    digest = hashlib.sha256("\n".join([version, *requirements]).encode()).hexdigest()
    cache = cache_folder()
    cache.mkdir(parents=True, exist_ok=True)
    # Environments hold their own path, so this one is made in its place; the stamp says that it is whole.
    folder = cache / f"venv-{digest[:16]}"
    stamp = folder / "planesweep-complete"
    with open(folder.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not stamp.exists():
            shutil.rmtree(folder, ignore_errors=True)
            try:
                install(requirements, folder)
            except (OSError, subprocess.CalledProcessError) as error:
                shutil.rmtree(folder, ignore_errors=True)
                sys.exit(f"reference_venv: {error}")
            stamp.write_text("\n".join(requirements))
    print(interpreter(folder))


if __name__ == "__main__":
    main()
