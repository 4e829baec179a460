#!/usr/bin/env bash
# Runs Docker Compose 2 with these arguments.
#
# Takes the docker command's own, or else the package of Debian 13, which is unpacked in the user's cache folder and
# runs on Debian 12, too. Exit code 77: there is none and none can be had.
set -euo pipefail

if docker compose version --short 2>/dev/null | grep -q '^v\?[2-9]'; then
    exec docker compose "$@"
fi
cache="${XDG_CACHE_HOME:-${HOME:-/tmp}/.cache}/planesweep"
plugin="$cache/docker-compose"

unpack() {
    local folder keyring=/usr/share/keyrings/debian-archive-keyring.gpg
    command -v apt-get >/dev/null || { echo "no Docker Compose is installed" >&2; return 1; }
    folder=$(mktemp -d)
    mkdir -p "$folder/lists/partial" "$folder/archives/partial"
    # Sources and lists of its own: the machine's stay as they are.
    echo "deb [signed-by=$keyring] http://deb.debian.org/debian trixie main" > "$folder/sources"
    local options=(-qq -o "Dir::Etc::sourcelist=$folder/sources" -o Dir::Etc::sourceparts=-
        -o "Dir::State::lists=$folder/lists" -o "Dir::Cache=$folder" -o "APT::Sandbox::User=$(id -un)")
    if (cd "$folder" && apt-get "${options[@]}" update && apt-get "${options[@]}" download docker-compose &&
        dpkg-deb --extract docker-compose_*.deb files) >"$plugin.log" 2>&1; then
        # Nothing ends at a failure within a condition.
        install "$folder/files/usr/libexec/docker/cli-plugins/docker-compose" "$plugin.part" &&
            mv "$plugin.part" "$plugin"
    else
        echo "Docker Compose 2 cannot be fetched; see $plugin.log" >&2
    fi
    rm -rf "$folder"
    [ -e "$plugin" ]
}

mkdir -p "$cache"
exec 9>"$plugin.lock"
flock 9
[ -e "$plugin" ] || unpack || exit 77
exec 9>&-
exec "$plugin" "$@"
