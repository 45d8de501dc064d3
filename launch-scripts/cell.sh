#!/bin/bash
# Runs the cell on a machine without ROS: the three nodes, each in a process of its own, started again where one ends.
# Ctrl-C or SIGTERM ends all of them.
#
#   launch-scripts/cell.sh [--ros-args …]        every argument goes to all three nodes
#
# Environment: BIN, the folder of the binaries (target/release); NODES, the nodes to run ("solver_node feature_node
# capture_node"), for a cell that is spread over several hosts; MEMORY_MB, the most address space a node may take (4096),
# which keeps a flood of malformed network packets from taking all memory; JOURNAL, a folder for the pieces that the solver
# node has taken in, which outlast even this script there (without it they outlast the nodes, but not the script).
#
# Ends with 0 after a signal, with 2 where a node finds a mistake in its arguments, which another start would not mend.
set -u
root=$(cd "$(dirname "$0")/.." && pwd)
bin=${BIN:-$root/target/release}
memory_mb=${MEMORY_MB:-4096}
read -ra nodes <<<"${NODES:-solver_node feature_node capture_node}"

first_pause=200 # milliseconds before a node is started again
last_pause=5000 # … where it has failed at once several times: its network may be down
lived_long=2    # seconds after which a failure counts as the first again
patience=3000   # milliseconds that the nodes have to end in order

for node in "${nodes[@]}"; do
    [ -x "$bin/$node" ] || { echo "$0: $bin/$node is missing: run cargo build --release, or set BIN" >&2; exit 2; }
done

# Keeps one node running until a signal comes, or until it finds a mistake in its arguments.
supervise() {
    local node=$1 child status pause=0 started ending=
    shift
    trap 'ending=yes' TERM INT
    while :; do
        nap "$pause"
        [ -z "$ending" ] || return 0
        started=$SECONDS
        # A node out of memory has none for a backtrace: it would hang instead of ending. With one arena glibc's allocator
        # keeps less of what pieces leave behind.
        (ulimit -v $((memory_mb * 1024)) && RUST_BACKTRACE=0 MALLOC_ARENA_MAX=1 exec "$bin/$node" "$@") &
        child=$!
        # A signal ends the wait, too. What bash itself says of a killed job is said below.
        [ -n "$ending" ] || { wait "$child"; } 2>/dev/null
        status=$?
        if [ -n "$ending" ]; then
            end "$child"
            return 0
        fi
        [ $status -ne 2 ] || return 2
        if [ $((SECONDS - started)) -ge $lived_long ]; then pause=$first_pause; else pause=$((2 * pause)); fi
        [ $pause -ge $first_pause ] || pause=$first_pause
        [ $pause -le $last_pause ] || pause=$last_pause
        echo "$node ended with status $status; starting it again" >&2
    done
}

# Waits some milliseconds. Reading from a pipe that nobody writes to leaves no process behind when a signal comes.
exec {never}<> <(:)
nap() { read -rt "$(($1 / 1000)).$(printf %03d $(($1 % 1000)))" -u "$never"; }

# Ends a node; kills it where it is stopped and does not hear.
end() {
    kill -TERM "$1" 2>/dev/null
    (nap $patience; kill -KILL "$1" 2>/dev/null) &
    # A further signal ends a wait, too.
    while kill -0 "$1" 2>/dev/null; do { wait "$1"; } 2>/dev/null; done
    kill $! 2>/dev/null
}

# A relative parameter, so that it reaches a solver node of another name or namespace as well.
journal=${JOURNAL:-}
if [ -z "$journal" ]; then
    journal=$(mktemp -d) || exit 1
    trap 'rm -rf "$journal"' EXIT
fi

supervisors=()
for node in "${nodes[@]}"; do
    own=()
    [ "$node" != solver_node ] || own=(-p "journal:=$journal")
    supervise "$node" --ros-args --params-file "$root/launch-scripts/$node.param.yaml" "${own[@]}" "$@" &
    supervisors+=($!)
done
trap 'kill -TERM "${supervisors[@]}" 2>/dev/null' TERM INT
status=0
# The first one that gives up takes the others along.
wait -n "${supervisors[@]}" || status=$?
kill -TERM "${supervisors[@]}" 2>/dev/null
wait
[ $status -gt 128 ] && status=0
exit $status
