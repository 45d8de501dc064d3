#!/usr/bin/env bash
# Makes the Python environment of the harness in tests/rclpy: a venv with a real rclpy from PyPI and, built by the standard
# rosidl generators, our own message packages. Nothing is done twice: a stamp holds the hash of what went in.
#
# Usage: tests/setup_venv.sh            prints the folder of the venv as its last line
# Environment: PYTHON names the interpreter (CPython 3.10 to 3.13), CARGO_TARGET_DIR where build products go.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
target=${CARGO_TARGET_DIR:-$root/target}
case $target in /*) ;; *) target=$root/$target ;; esac
venv=$target/rclpy-venv
work=$target/rclpy-build

say() { echo "setup_venv: $*" >&2; }
die() { say "$*"; exit 1; }

# Runs a step quietly; its output is shown when it fails.
quietly() {
    local what=$1
    shift
    "$@" >"$work/log" 2>&1 || { cat "$work/log" >&2; die "$what failed"; }
}

# --- the interpreter -------------------------------------------------------------------------------------------------
fits='import sys; v = sys.version_info; sys.exit(not ((3, 10) <= v[:2] <= (3, 13) and sys.implementation.name == "cpython"))'
python=
for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11 python3.10}; do
    if "$candidate" -c "$fits" 2>/dev/null; then
        python=$(command -v "$candidate")
        break
    fi
done
[ -n "$python" ] || die "no CPython 3.10 to 3.13 found; name one in PYTHON"
"$python" -c 'import ensurepip, venv' 2>/dev/null ||
    die "$python cannot make a venv; install its venv module (Debian and Ubuntu: apt-get install python3-venv)"
[ -f "$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')/Python.h" ] ||
    die "$python has no headers, which the message packages need (Debian and Ubuntu: apt-get install python3-dev)"
command -v c++ >/dev/null || die "no C++ compiler, which the message packages need (Debian and Ubuntu: apt-get install g++)"

mkdir -p "$work"
touch "$work/COLCON_IGNORE" # the packages in here are not those of a ROS workspace around us
exec 9>"$work/lock"
flock 9 # two runs at the same time would build into each other

# --- stage 1: wheels -------------------------------------------------------------------------------------------------
hash_of() { sha256sum "$@" | sha256sum | cut -c1-64; }
cd "$root"
inputs=(tests/setup_venv.sh tests/rclpy/requirements.txt tests/rclpy/constraints.txt)
wheels_stamp="$("$python" -c 'import sys; print(sys.version, sys.base_prefix)') $(hash_of "${inputs[@]}") $venv"
if [ "$(cat "$venv/wheels.stamp" 2>/dev/null)" != "$wheels_stamp" ]; then
    say "installing rclpy and what builds messages (under a minute)"
    rm -rf "$venv" "$work/packages"
    quietly "making the venv" "$python" -m venv "$venv"
    touch "$venv/COLCON_IGNORE"
    quietly "installing from PyPI" "$venv/bin/pip" install --disable-pip-version-check --quiet \
        -r tests/rclpy/requirements.txt -c tests/rclpy/constraints.txt
    # The wheels' CMake files name the header folders of the machine they were built on.
    py=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
    np=$("$venv/bin/python" -c 'import numpy; print(numpy.get_include())')
    grep -rlIE '/opt/python/cp[0-9]+-cp[0-9]+' "$venv/share" | xargs -r sed -i -E \
        "s#/opt/python/cp[0-9]+-cp[0-9]+/lib/python3\.[0-9]+/site-packages/numpy/_core/include#$np#g
         s#/opt/python/cp[0-9]+-cp[0-9]+/include/python3\.[0-9]+#$py#g"
    echo "$wheels_stamp" >"$venv/wheels.stamp"
fi

# --- stage 2: messages -----------------------------------------------------------------------------------------------
# No wheel holds tf2_msgs, so it is built from our own definition, as a package of its own.
tf2=$work/packages/tf2_msgs
mkdir -p "$tf2/msg"
cat >"$tf2/package.xml" <<'XML'
<package format="3">
  <name>tf2_msgs</name>
  <version>0.0.0</version>
  <description>Transforms of a frame tree</description>
  <maintainer email="maintainers@jigsaw-cell.example">The isthmus jigsaw cell authors</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>geometry_msgs</depend>
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
XML
cat >"$tf2/CMakeLists.txt" <<'CMAKE'
cmake_minimum_required(VERSION 3.16)
project(tf2_msgs)
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(tf2_msgs msg/TFMessage.msg DEPENDENCIES geometry_msgs)
ament_package()
CMAKE
cmp -s msgs/standard/tf2_msgs/msg/TFMessage.msg "$tf2/msg/TFMessage.msg" ||
    cp msgs/standard/tf2_msgs/msg/TFMessage.msg "$tf2/msg/TFMessage.msg"

mapfile -t inputs < <(find msgs/msg msgs/action msgs/CMakeLists.txt msgs/package.xml "$tf2" -type f | LC_ALL=C sort)
messages_stamp="$(hash_of "${inputs[@]}") $wheels_stamp"
if [ "$(cat "$venv/messages.stamp" 2>/dev/null)" != "$messages_stamp" ]; then
    say "building jigsaw_msgs and tf2_msgs for rclpy (about a minute)"
    libraries=$venv/lib
    site=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("platlib"))')
    for folder in "$site"/ros_*.libs; do libraries=$libraries:$folder; done
    export PATH=$venv/bin:$PATH LD_LIBRARY_PATH=$libraries AMENT_PREFIX_PATH=$venv PYTHONPATH=$site
    export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
    for package in "$tf2" "$root/msgs"; do
        name=$(sed -n 's#.*<name>\(.*\)</name>.*#\1#p' "$package/package.xml")
        rm -rf "${work:?}/$name" # a folder that was moved or half built is of no use to CMake
        # Quick to build is worth more here than quick to run.
        quietly "configuring $name" cmake -G Ninja -S "$package" -B "$work/$name" -DCMAKE_BUILD_TYPE=None \
            -DCMAKE_C_FLAGS=-O0 -DCMAKE_CXX_FLAGS=-O0 -DBUILD_TESTING=OFF \
            -DCMAKE_PREFIX_PATH="$venv" -DCMAKE_INSTALL_PREFIX="$venv" -DPython3_EXECUTABLE="$venv/bin/python"
        quietly "building $name" cmake --build "$work/$name"
        quietly "installing $name" cmake --install "$work/$name"
    done
    echo "$messages_stamp" >"$venv/messages.stamp"
fi
echo "$venv"
