#!/usr/bin/env bash
# The cell at work, on a machine without ROS: builds it, starts capture, feature and solver node as processes of their own,
# plays a bag of camera frames to them over DDS (loopback), waits for the assembly, prints where each piece goes, and writes
# assembly.png and assembly.json. Ends with 0 if and only if all pieces were placed.
#
# Usage: launch-scripts/demo.sh [OUT]        results go to OUT (default: target/demo)
# Environment: BAG      bag to play (default: bags/puzzle24)
#              PIECES   pieces in it (default: 24)
#              TIMEOUT  seconds until the assembly counts as failed (default: 120)
#              ROS_DOMAIN_ID  DDS domain (default: 88, so as not to meet other ROS nodes of this machine)
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
out=$(realpath -m "${1:-$root/target/demo}")
bag=$(realpath -m "${BAG:-$root/bags/puzzle24}")
pieces=${PIECES:-24}
limit=${TIMEOUT:-120}
export ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-88} ROS_LOCALHOST_ONLY=1

command -v cargo >/dev/null || { echo "demo: cargo is needed: see https://rustup.rs" >&2; exit 2; }
cd "$root"
echo "demo: building (the first time ten minutes or more, on two cores)"
cargo build --release --bins
bin=$(realpath -m "${CARGO_TARGET_DIR:-target}")/release

mkdir -p "$out"
rm -f "$out"/assembly.{png,json}

running=()
end_all() {
    for pid in "${running[@]}"; do kill -INT "$pid" 2>/dev/null || true; done
    for pid in "${running[@]}"; do wait "$pid" 2>/dev/null || true; done
}
trap end_all EXIT
trap 'exit 130' INT TERM

for node in capture_node feature_node solver_node; do
    "$bin/$node" >"$out/$node.log" 2>&1 &
    running+=($!)
done
"$bin/jigsaw" watch --out "$out" --pieces "$pieces" --timeout "$limit" >"$out/result.txt" 2>"$out/watch.log" &
watch=$!
running+=("$watch")

echo "demo: capture, feature and solver node run in DDS domain $ROS_DOMAIN_ID; playing $bag"
timeout "$limit" "$bin/jigsaw" bag play "$bag" --rate 0 2>"$out/play.log" || { cat "$out/play.log" >&2; exit 1; }

code=0
wait "$watch" || code=$?
cat "$out/result.txt"
if [ "$code" -ne 0 ]; then
    cat "$out/watch.log" >&2
    echo "demo: FAILED; what the nodes say is in $out/*.log" >&2
    exit "$code"
fi
echo "demo: the results are in $out:" $(cd "$out" && ls assembly.*)
