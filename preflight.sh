#!/bin/sh
# Names every missing system package in one message, before anything is installed. Needs no root, changes nothing.
py=${PYTHON:-python3}
missing=""
need() { missing="$missing
  - $1"; }
if ! command -v "$py" >/dev/null 2>&1; then
  need "Python 3.11 or newer ('$py' not found): apt install python3"
else
  "$py" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    need "Python 3.11 or newer (found $("$py" -V 2>&1)): install one, then make PYTHON=python3.12 ..."
  "$py" -c 'import venv, ensurepip' 2>/dev/null || need "the venv module: apt install python3-venv"
  "$py" -c 'import os, sysconfig; open(os.path.join(sysconfig.get_path("include"), "Python.h"))' 2>/dev/null ||
    need "the Python headers: apt install python3-dev"
fi
cxx=""
for c in "${CXX:-}" c++ g++ clang++; do
  [ -n "$c" ] && command -v "$c" >/dev/null 2>&1 && cxx=$c && break
done
if [ -z "$cxx" ]; then
  need "a C++17 compiler: apt install g++"
elif ! echo 'int main() { if constexpr (true) return 0; }' | "$cxx" -std=c++17 -x c++ -fsyntax-only - 2>/dev/null; then
  need "a compiler that knows C++17 ('$cxx' does not): apt install g++"
fi
[ -z "$missing" ] && exit 0
echo "spikerig cannot be built here yet. Missing:$missing" >&2
echo "On Debian or Ubuntu, all of it at once: sudo apt install python3 python3-venv python3-dev g++ make" >&2
exit 6
