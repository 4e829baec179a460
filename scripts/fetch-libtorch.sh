#!/usr/bin/env bash
# Puts libtorch 2.13.0 (CPU) into the user's cache folder and links it as .libtorch beside Cargo.toml.
#
# Does nothing when LIBTORCH is set or when the cache is good. The files come from the PyPI wheels
# of torch and of the two CUDA runtime libraries that its CPU part links; nothing is installed into
# any Python environment. Downloads are resumed and checked by sha256.
set -euo pipefail

here=$(cd "$(dirname "$0")/.." && pwd)
if [ -n "${LIBTORCH:-}" ]; then
    echo "libtorch: using LIBTORCH=$LIBTORCH" >&2
    exit 0
fi

# A link that is made anew has all programs linked again.
link() { [ "$here/.libtorch" -ef "$cache" ] || ln -sfn "$cache" "$here/.libtorch"; }

cache="${XDG_CACHE_HOME:-$HOME/.cache}/planesweep/libtorch-2.13.0-cpu"
if command -v python3 >/dev/null && python3 "$here/scripts/fetch_libtorch.py" --check "$cache"; then
    link
    exit 0
fi

missing=""
command -v python3 >/dev/null || missing="$missing python3 python3-pip"
command -v c++ >/dev/null || missing="$missing g++"
if command -v python3 >/dev/null && ! python3 -m pip --version >/dev/null 2>&1; then
    missing="$missing python3-pip"
fi
if [ -n "$missing" ]; then
    echo "libtorch: this machine lacks:$missing. On Debian or Ubuntu: apt-get install$missing" >&2
    exit 1
fi
if [ "$(uname -sm)" != "Linux x86_64" ]; then
    echo "libtorch: no download for $(uname -sm); install libtorch 2.13.0 yourself and set LIBTORCH" >&2
    exit 1
fi

python3 "$here/scripts/fetch_libtorch.py" "$cache"
link
