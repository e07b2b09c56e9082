# PostgreSQL on port $2 until standard input ends; "restart" there kills and restarts it. $1 is the folder of its programs.
set -eu
data=$(mktemp -d "${TMPDIR:-/tmp}/postgres.XXXXXX")
as=""
if [ "$(id -u)" = 0 ]; then
    chown postgres "$data"
    as="runuser -u postgres --"
fi
cd "$data"
trap '$as "$1/pg_ctl" -D "$data/data" -m immediate stop >/dev/null 2>&1; cd /; rm -rf "$data"' EXIT
$as "$1/initdb" -D "$data/data" -A trust -U postgres --no-sync -E UTF8 --locale=C >/dev/null
start() {
    $as "$1/pg_ctl" -D "$data/data" -w -l "$data/log" \
        -o "-p $2 -c listen_addresses=127.0.0.1 -c unix_socket_directories=$data -c max_connections=200" start >/dev/null
}
start "$1" "$2"
echo ready
while read -r word; do
    case $word in
    restart)
        $as "$1/pg_ctl" -D "$data/data" -m immediate stop >/dev/null
        start "$1" "$2"
        ;;
    esac
done
