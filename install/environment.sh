#!/usr/bin/env bash
# Makes the virtual environment $1 with a Python that the studio runs on: 3.11 where there is one, else 3.12 or 3.13,
# else a 3.11 that uv fetches. PYTHON=/path/to/python chooses another.
set -euo pipefail
venv=$1

# What keeps the studio from running on Python $1, one reason a line. There is a wheel of the physics engine for 3.11;
# for newer ones it is compiled. On those the workflow engine asks SQLite for parts of a second.
lacks() {
  "$1" -c '
import sys
if not (3, 11) <= sys.version_info[:2] <= (3, 13):
    print("is not Python 3.11, 3.12 or 3.13")
    sys.exit()
import importlib, os, shutil, sysconfig
for module, package in (("ensurepip", "python3-venv"), ("sqlite3", "libsqlite3-dev before it is built")):
    try:
        importlib.import_module(module)
    except ImportError:
        print("lacks its module " + module + " (install " + package + ")")
if sys.version_info[:2] > (3, 11):
    if not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")):
        print("lacks the headers that build the physics engine (install python3-dev)")
    if not shutil.which("g++"):
        print("needs g++, which builds the physics engine (install g++)")
    sqlite3 = sys.modules.get("sqlite3")
    if sqlite3 and sqlite3.sqlite_version_info < (3, 42):
        print("needs SQLite 3.42 and has " + sqlite3.sqlite_version + " (Python 3.11 does without)")
' 2>/dev/null || echo "does not start"
}
make_venv() {
  echo "Creating $venv with $("$1" --version) ..."
  "$1" -m venv "$venv"
}

if [ -n "${PYTHON:-}" ]; then
  reasons=$(lacks "$PYTHON")
  [ -z "$reasons" ] || { sed "s|^|PYTHON=$PYTHON |; s|\$|.|" <<<"$reasons"; exit 1; }
  make_venv "$PYTHON"
  exit
fi
for name in python3.11 python3.12 python3.13 python3; do
  command -v "$name" >/dev/null || continue
  reasons=$(lacks "$name")
  [ -n "$reasons" ] || { make_venv "$name"; exit; }
  sed "s|^|$name |; s|\$|.|" <<<"$reasons"
done

echo "No Python fits as it is; fetching Python 3.11 with uv ..."
fetch() { uv venv --quiet --seed --python 3.11 "$venv"; }
if command -v uv >/dev/null; then
  fetch && exit
else
  for name in python3 python; do
    tools=$(mktemp -d)
    if "$name" -m venv "$tools" 2>/dev/null && "$tools/bin/python" -m pip install --quiet --disable-pip-version-check uv; then
      PATH="$tools/bin:$PATH" fetch && { rm -rf "$tools"; exit; }
    fi
    rm -rf "$tools"
  done
fi
cat <<'HELP'
PbARL Studio needs Python 3.11, 3.12 or 3.13, and found no way to one.
  Debian, Ubuntu:  sudo apt-get install python3-venv python3-dev g++     then again: make run
  Any Linux:       install uv (https://docs.astral.sh/uv/)               then again: make run
  With Docker:     docker compose up --build                             (needs nothing but Docker)
HELP
exit 1
