#!/usr/bin/env bash
# Runs twin.py with PyTorch 2.13 from PyPI, in an environment in the user's cache folder that is made when it is not
# there (about 2 GB to fetch, 4 GB on the disk; python3 3.11 to 3.13 with pip and venv are needed).
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
venv="${XDG_CACHE_HOME:-$HOME/.cache}/planesweep/twin-torch-2.13.0"
if ! cmp -s "$here/requirements.txt" "$venv/planesweep-complete"; then
    rm -rf "$venv"
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check --no-deps --only-binary=:all: -r "$here/requirements.txt"
    # Written last, it says that all is there.
    cp "$here/requirements.txt" "$venv/planesweep-complete"
fi
exec "$venv/bin/python" "$here/twin.py" "$@"
