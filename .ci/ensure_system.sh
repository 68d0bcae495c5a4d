#!/usr/bin/env bash
# SPDX-License-Identifier: MIT
# Installs dependencies that pip cannot: usage `ensure_system.sh llvm|blender|tests`.
#   llvm     LLVM 19 or later, which Mitsuba compiles its kernels with
#   blender  the shared libraries that Blender's Python module links to
#   tests    Slurm, a browser and Khronos' glTF validator; the tests that need a missing one are skipped
# Uses apt-get as root or through password-less sudo; otherwise prints the packages to install.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${VENV:-.venv}/bin/python

as_root=()
can_install=no
if command -v apt-get >/dev/null 2>&1; then
    if [ "$(id -u)" = 0 ]; then
        can_install=yes
    elif command -v sudo >/dev/null 2>&1 && sudo -n true 2>/dev/null; then
        can_install=yes
        as_root=(sudo)
    fi
fi

install_packages() {
    echo "installing $* with apt-get"
    if ! DEBIAN_FRONTEND=noninteractive "${as_root[@]}" apt-get install -y -qq --no-install-recommends "$@" >/dev/null 2>&1; then
        "${as_root[@]}" apt-get update -qq
        DEBIAN_FRONTEND=noninteractive "${as_root[@]}" apt-get install -y -qq --no-install-recommends "$@" >/dev/null
    fi
}

ensure_llvm() {
    if ! ldconfig -p 2>/dev/null | grep -q libatomic.so.1; then
        if [ $can_install = no ]; then
            echo "Mitsuba needs: apt-get install libatomic1" >&2
            exit 1
        fi
        install_packages libatomic1
    fi
    if "$python" -c 'from mitsuba_plugins.variant import choose_llvm; choose_llvm()' 2>/dev/null; then
        return
    fi
    if [ $can_install = no ]; then
        echo "LLVM 19 or later is missing. Ask an administrator for: apt-get install libllvm19" >&2
        echo "(or set DRJIT_LIBLLVM_PATH to a libLLVM shared library, 19 or later)" >&2
        exit 1
    fi
    "${as_root[@]}" apt-get update -qq
    local package=""
    for major in 19 20 21 22; do
        for name in "libllvm$major" "libllvm${major}t64"; do
            if apt-cache show "$name" >/dev/null 2>&1; then
                package=$name
                break 2
            fi
        done
    done
    if [ -z "$package" ]; then
        echo "this system's package manager has no libllvm19 or later; install LLVM 19 or later by other" >&2
        echo "means and set DRJIT_LIBLLVM_PATH to its libLLVM shared library" >&2
        exit 1
    fi
    install_packages "$package"
    "$python" -c 'from mitsuba_plugins.variant import choose_llvm; print("LLVM:", choose_llvm().path)'
}

ensure_blender() {
    local missing=()
    add_unless_found() { # soname, Debian package
        ldconfig -p 2>/dev/null | grep -q "$1" || missing+=("$2")
    }
    add_unless_found libX11.so.6 libx11-6
    add_unless_found libXrender.so.1 libxrender1
    add_unless_found libXxf86vm.so.1 libxxf86vm1
    add_unless_found libXfixes.so.3 libxfixes3
    add_unless_found libXi.so.6 libxi6
    add_unless_found libXext.so.6 libxext6
    add_unless_found libxkbcommon.so.0 libxkbcommon0
    add_unless_found libSM.so.6 libsm6
    add_unless_found libICE.so.6 libice6
    add_unless_found libGL.so.1 libgl1
    add_unless_found libEGL.so.1 libegl1
    [ ${#missing[@]} = 0 ] && return
    if [ $can_install = no ]; then
        echo "Blender's Python module needs: apt-get install ${missing[*]}" >&2
        exit 1
    fi
    install_packages "${missing[@]}"
}

ensure_validator() {
    if ! command -v npm >/dev/null 2>&1; then
        echo "one test of glTF files will skip; it needs node and npm" >&2
    elif [ ! -d .ci/gltf/node_modules ]; then
        (cd .ci/gltf && npm ci --silent --ignore-scripts --no-audit --no-fund) ||
            echo "one test of glTF files will skip: npm could not install gltf-validator" >&2
    fi
}

ensure_tests() {
    ensure_validator
    local missing=()
    { command -v slurmctld || [ -x /usr/sbin/slurmctld ]; } >/dev/null 2>&1 || missing+=(slurm-wlm)
    { command -v munged || [ -x /usr/sbin/munged ]; } >/dev/null 2>&1 || missing+=(munge)
    command -v chromium >/dev/null 2>&1 || missing+=(chromium)
    command -v chromedriver >/dev/null 2>&1 || missing+=(chromium-driver)
    [ ${#missing[@]} = 0 ] && return
    if [ $can_install = no ]; then
        echo "some tests will skip; they need: apt-get install ${missing[*]}" >&2
        return
    fi
    install_packages "${missing[@]}" || echo "some tests will skip: apt-get could not install ${missing[*]}" >&2
}

case "${1:-}" in
    llvm) ensure_llvm ;;
    blender) ensure_blender ;;
    tests) ensure_tests ;;
    *) echo "usage: $0 llvm|blender|tests" >&2; exit 2 ;;
esac
