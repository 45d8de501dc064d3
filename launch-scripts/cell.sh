#!/bin/bash
# Runs the cell on a machine without ROS: the three nodes, each in a process of its own, started again where one ends
# by a fault. Ctrl-C ends all of them.
#
#   launch-scripts/cell.sh [--ros-args …]        every argument goes to all three nodes
#
# Environment: BIN, the folder of the binaries (target/release); MEMORY_MB, the most address space a node may take
# (4096), which keeps a flood of malformed network packets from taking all memory.
set -u
root=$(cd "$(dirname "$0")/.." && pwd)
bin=${BIN:-$root/target/release}
memory_mb=${MEMORY_MB:-4096}

for node in capture_node feature_node solver_node; do
    [ -x "$bin/$node" ] || { echo "$0: $bin/$node is missing: run cargo build --release, or set BIN" >&2; exit 2; }
done

supervise() {
    local node=$1 child status
    shift
    trap 'kill -TERM "$child" 2>/dev/null; wait "$child" 2>/dev/null; exit 0' TERM INT
    while :; do
        (ulimit -v $((memory_mb * 1024)) && exec "$bin/$node" "$@") &
        child=$!
        wait "$child"
        status=$?
        # 0: ended in order. 2: a mistake in the arguments, which another start would not mend.
        [ $status -eq 0 ] || [ $status -eq 2 ] && return $status
        echo "$node ended with status $status; starting it again" >&2
        sleep 0.2
    done
}

supervisors=()
for node in solver_node feature_node capture_node; do
    supervise "$node" --ros-args --params-file "$root/launch-scripts/$node.param.yaml" "$@" &
    supervisors+=($!)
done
trap 'kill -TERM "${supervisors[@]}" 2>/dev/null' TERM INT
status=0
# The first one that ends takes the others along.
wait -n "${supervisors[@]}" || status=$?
kill -TERM "${supervisors[@]}" 2>/dev/null
wait
[ $status -gt 128 ] && status=0
exit $status
