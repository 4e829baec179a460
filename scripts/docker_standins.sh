#!/usr/bin/env bash
# Makes images that stand in for those that docker/compose.yaml takes from a registry, where none can be reached: they
# get the same variables, commands, volumes and questions.
#
#   scripts/docker_standins.sh IMAGE S3_SERVER NAME
#
# NAME-postgres is PostgreSQL of this host's Debian package; NAME-s3 is the program S3_SERVER. IMAGE is one of
# scripts/docker_image.sh. Exit code 77: there is no PostgreSQL.
set -euo pipefail
image=$1 s3_server=$2 name=$3

bin=$("$(dirname "$0")/postgres.sh" --binaries)
version=$(basename "$(dirname "$bin")")
context=$(mktemp -d)
trap 'rm -rf "$context"' EXIT

mkdir -p "$context/postgres/lib"
cp -r --parents "/usr/share/postgresql/$version" "$bin" "/usr/lib/postgresql/$version/lib" "$context/postgres"
# Compiled queries are not worth their compiler.
rm -rf "$context/postgres/usr/lib/postgresql/$version/lib"/{bitcode,llvmjit*}
# All but the C library's own, which the image has.
ldd "$bin"/{postgres,initdb,pg_isready} | awk '$2 == "=>" { print $3 }' | sort -u |
    grep -Ev '/(libc|libm|libdl|librt|libpthread|libresolv)\.so' | xargs cp -L -t "$context/postgres/lib"
cat > "$context/postgres/serve" <<'SERVE'
#!/bin/sh -e
cd /var/lib/postgresql/data
if [ ! -e PG_VERSION ]; then
    echo "$POSTGRES_PASSWORD" > /tmp/password
    initdb --username "$POSTGRES_USER" --pwfile /tmp/password --auth scram-sha-256 --locale=C -E UTF8 --no-sync .
    echo "host all all all scram-sha-256" >> pg_hba.conf
    echo "CREATE DATABASE $POSTGRES_USER" | postgres --single -D . postgres
fi
exec postgres -D . -c "listen_addresses=*" -c unix_socket_directories= -c fsync=off
SERVE
cat > "$context/postgres.docker" <<DOCKER
FROM $image
USER root
RUN useradd --uid 999 --system postgres && install -d -o postgres -m 700 /var/lib/postgresql/data
COPY postgres/usr /usr
COPY postgres/lib /usr/local/lib
COPY postgres/serve /usr/local/bin/serve
RUN ldconfig && chmod 755 /usr/local/bin/serve
ENV PATH=$bin:/usr/local/bin:/usr/bin:/bin
USER postgres
HEALTHCHECK NONE
STOPSIGNAL SIGINT
ENTRYPOINT ["serve"]
DOCKER

cp "$s3_server" "$context/s3_server"
cat > "$context/s3.docker" <<DOCKER
FROM $image
USER root
COPY s3_server /usr/local/bin/s3_server
HEALTHCHECK NONE
# As the first process it would not hear SIGTERM.
STOPSIGNAL SIGKILL
ENTRYPOINT ["s3_server"]
DOCKER

chmod -R a+rX "$context"
for one in postgres s3; do
    docker build --quiet --network host -f "$context/$one.docker" -t "$name-$one" "$context"
done
