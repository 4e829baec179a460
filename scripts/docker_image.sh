#!/usr/bin/env bash
# Makes the image of a program that is built already, with the libtorch that it was built with.
#
#   scripts/docker_image.sh PROGRAM IMAGE
#
# The base image is pulled, or, where no registry can be reached, made of Debian's packages and kept in the user's
# cache folder. Exit code 77: this machine cannot make it.
set -euo pipefail
program=$1 image=$2
here=$(cd "$(dirname "$0")/.." && pwd)

# The program runs where the C library is as new as the one it was linked with.
. /etc/os-release
[ "${ID:-}" = debian ] || { echo "images are Debian's, and this program was built for ${ID:-something else}" >&2; exit 77; }
base="debian:$VERSION_CODENAME-slim"

debootstrap_base() {
    local archive=$1 folder
    if ! command -v debootstrap >/dev/null; then
        DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends debootstrap >/dev/null 2>&1 || return
    fi
    folder=$(mktemp -d)
    if debootstrap --variant=minbase --include=ca-certificates "$VERSION_CODENAME" "$folder" \
        http://deb.debian.org/debian >"$archive.log" 2>&1; then
        tar -C "$folder" --exclude='./var/cache/apt/*' --exclude='./var/lib/apt/lists/*' \
            --exclude='./usr/share/doc/*' --exclude='./usr/share/locale/*' -cf "$archive.part" .
        mv "$archive.part" "$archive"
    fi
    rm -rf "$folder"
    [ -e "$archive" ]
}

if ! docker image inspect "$base" >/dev/null 2>&1 && ! timeout 60 docker pull -q "$base" >/dev/null 2>&1; then
    cache="${XDG_CACHE_HOME:-$HOME/.cache}/planesweep"
    mkdir -p "$cache"
    archive="$cache/debian-$VERSION_CODENAME.tar"
    exec 9>"$archive.lock"
    flock 9
    [ -e "$archive" ] || debootstrap_base "$archive" ||
        { echo "no registry can be reached and debootstrap fails; see $archive.log" >&2; exit 77; }
    docker import "$archive" "$base" >/dev/null
fi

context=$(mktemp -d)
trap 'rm -rf "$context"' EXIT
libtorch=$(ldd "$program" | awk '$1 == "libtorch_cpu.so" { print $3 }')
mkdir "$context/lib"
cp "$program" "$context/planesweep"
cp -L "$(dirname "$libtorch")"/*.so* "$context/lib/"
# Everyone may read and run it, whatever the umask was.
chmod -R a+rX "$context"
# BuildKit wants a network, and an engine of the tests has none of its own.
docker build --quiet --network host -f "$here/docker/Dockerfile" --target built --build-arg "DEBIAN=$base" \
    -t "$image" "$context"
