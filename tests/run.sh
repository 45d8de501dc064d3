#!/usr/bin/env bash
# All tests: those of cargo (unit tests, documentation examples, process tests), then the harness of rclpy nodes.
# Ends with 0 if and only if all of them pass.
#
# Usage: tests/run.sh [ARGUMENT…]       arguments go to pytest, such as `-k parameters`
# Needs a Rust toolchain, a C++ compiler and CPython 3.10 to 3.13; everything else is fetched into the target folder.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# The Python environment is made while cargo compiles: both spend much of their time on one core.
log=$(mktemp)
trap 'rm -f "$log"' EXIT
tests/setup_venv.sh >"$log" 2>&1 &
venv_job=$!

failed=()
cargo test --workspace --quiet || failed+=("cargo test")

if wait "$venv_job"; then
    venv=$(tail -n 1 "$log")
    "$venv/bin/python" -m pytest -o cache_dir="${venv%/*}/pytest-cache" tests/rclpy "$@" || failed+=("rclpy harness")
else
    cat "$log" >&2
    failed+=("tests/setup_venv.sh")
fi

if [ ${#failed[@]} -gt 0 ]; then
    printf 'FAILED: %s\n' "${failed[@]}" >&2
    exit 1
fi
echo "all tests passed"
