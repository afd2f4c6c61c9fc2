#!/usr/bin/env bash
# Makes the virtual environment $1 with a Python that the studio runs on: 3.11 where there is one, else 3.12 or 3.13,
# else a 3.11 that uv fetches. PYTHON=/path/to/python chooses another.
set -euo pipefail
venv=$1

version() { "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null || true; }
fits() { case "$(version "$1")" in 3.11 | 3.12 | 3.13) true ;; *) false ;; esac }
# The physics engine has wheels for 3.11; for newer ones it is compiled, with the headers of that Python.
ready() {
  [ "$(version "$1")" = 3.11 ] && "$1" -c 'import ensurepip' 2>/dev/null && return
  "$1" -c 'import ensurepip, os, sysconfig as s; assert os.path.exists(s.get_path("include") + "/Python.h")' 2>/dev/null &&
    command -v g++ >/dev/null
}
make_venv() {
  echo "Creating $venv with $("$1" --version) ..."
  "$1" -m venv "$venv"
}

if [ -n "${PYTHON:-}" ]; then
  fits "$PYTHON" || { echo "PYTHON=$PYTHON is not a Python from 3.11 to 3.13."; exit 1; }
  ready "$PYTHON" || { echo "$PYTHON lacks its venv module, or g++ and the headers that build the physics engine: install python3-venv, python3-dev and g++."; exit 1; }
  make_venv "$PYTHON"
  exit
fi
for name in python3.11 python3.12 python3.13 python3; do
  if command -v "$name" >/dev/null && fits "$name" && ready "$name"; then
    make_venv "$name"
    exit
  fi
done

echo "No Python 3.11 here, nor 3.12 or 3.13 with g++ and headers; fetching Python 3.11 with uv ..."
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
