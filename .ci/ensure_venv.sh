#!/usr/bin/env bash
# SPDX-License-Identifier: MIT
# Creates the virtual environment: usage `ensure_venv.sh PYTHON FOLDER`. Debian packages venv separately.
set -euo pipefail
python=$1
folder=$2
if ! command -v "$python" >/dev/null 2>&1; then
    echo "$python is missing. Debian/Ubuntu: apt-get install python3.11 (or give another: make PYTHON=python3.12)" >&2
    exit 1
fi
[ -x "$folder/bin/pip" ] && exit 0
if "$python" -m venv "$folder" >/dev/null 2>&1; then
    exit 0
fi
rm -rf "$folder"
package=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
if command -v apt-get >/dev/null 2>&1 && [ "$(id -u)" = 0 ]; then
    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "$package" >/dev/null
elif command -v apt-get >/dev/null 2>&1 && sudo -n true 2>/dev/null; then
    sudo apt-get update -qq && sudo apt-get install -y -qq "$package" >/dev/null
else
    echo "$python cannot create virtual environments. Debian/Ubuntu: apt-get install $package" >&2
    exit 1
fi
"$python" -m venv "$folder"
