#!/usr/bin/env bash
# Serves Docker Engine from a folder until it is told to stop; tests start it where no engine runs.
#
#   scripts/docker_engine.sh FOLDER        unix://FOLDER/docker.sock
#
# Takes Debian's packages, and installs them when they are missing. Nothing of the host's network is changed but
# for the bridges of the tests' own networks, so containers reach each other and nothing else. Exit code 77: there
# is no engine, and none can be installed or started.
set -euo pipefail
folder=$1

[ "$(id -u)" = 0 ] || { echo "Docker Engine needs root" >&2; exit 77; }
missing() { for name in dockerd docker iptables; do command -v "$name" >/dev/null || return 0; done; return 1; }
if missing; then
    command -v apt-get >/dev/null || { echo "no Docker Engine is installed" >&2; exit 77; }
    install() { DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends docker.io iptables; }
    { install || { apt-get update -qq && install; }; } >/dev/null 2>&1 || true
    ! missing || { echo "docker.io cannot be installed" >&2; exit 77; }
fi
mkdir -p "$folder"
# Its name service for containers uses iptables in the containers, not on the host.
exec dockerd --host "unix://$folder/docker.sock" --data-root "$folder/data" --exec-root "$folder/exec" \
    --pidfile "$folder/pid" --bridge none --iptables=false --ip-forward=false --ip-masq=false --log-level warn
