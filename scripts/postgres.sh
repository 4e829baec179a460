#!/usr/bin/env bash
# Serves a PostgreSQL database in a folder on a port of the loopback interface until it is told to stop; the
# folder is made the first time. Tests start it.
#
#   scripts/postgres.sh FOLDER PORT        postgres://planesweep@127.0.0.1:PORT/postgres
#   scripts/postgres.sh --binaries         says in which folder its programs are, and does no more
#
# Takes Debian's package, and installs it when it is missing and root asks. The server refuses to run as root, so
# it then runs as the package's user. Exit code 77: there is no PostgreSQL and none can be installed.
set -euo pipefail

binaries() { ls -d /usr/lib/postgresql/*/bin 2>/dev/null | sort -V | tail -n 1; }
if [ -z "$(binaries)" ] && [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    DEBIAN_FRONTEND=noninteractive apt-get install -qq -y postgresql >/dev/null ||
        { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -qq -y postgresql >/dev/null; } || true
fi
bin=$(binaries)
[ -n "$bin" ] || { echo "no PostgreSQL is installed" >&2; exit 77; }
if [ "$1" = --binaries ]; then
    echo "$bin"
    exit
fi
folder=$1 port=$2

as=()
if [ "$(id -u)" = 0 ]; then
    as=(setpriv --reuid=postgres --regid=postgres --clear-groups)
fi
if [ ! -e "$folder/data/PG_VERSION" ]; then
    mkdir -p "$folder/data"
    [ "$(id -u)" != 0 ] || chown postgres "$folder/data"
    chmod 700 "$folder/data"
    # Whoever runs tests on this host may look at them.
    "${as[@]}" "$bin/initdb" -D "$folder/data" -U planesweep --auth=trust --locale=C -E UTF8 --no-sync >/dev/null
fi
# Tests kill the server, not the machine: what the kernel has is safe.
exec "${as[@]}" "$bin/postgres" -D "$folder/data" -p "$port" -c listen_addresses=127.0.0.1 \
    -c unix_socket_directories= -c fsync=off -c shared_buffers=16MB -c max_connections=50
