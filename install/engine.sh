#!/usr/bin/env bash
# Builds the physics engine's pinned source with the virtual environment $1, where there is no wheel of it for this
# Python. It takes about four minutes on two cores, so it says how far it is. numpy must be there already, or the
# engine is built without arrays, and hands over pictures pixel by pixel.
set -euo pipefail
venv=$1 python=$1/bin/python
[ "$("$python" -c 'import sys; print(sys.version_info[:2] == (3, 11))')" = True ] && exit
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
pinned() { sed -n "/^$1==/,/[^\\\\]\$/p" requirements.lock; }
(pinned numpy && pinned setuptools) >"$work/tools.lock"
pinned pybullet >"$work/engine.lock"
"$python" -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r "$work/tools.lock"
echo "Building the physics engine from source, once for this Python (about four minutes on two cores) ..."
TMPDIR=$work "$python" -m pip wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation --no-binary pybullet \
  --require-hashes -r "$work/engine.lock" -w "$work/wheels" >"$work/log" 2>&1 &
build=$!
started=$SECONDS
while kill -0 "$build" 2>/dev/null; do
  sleep 10
  echo "  $(find "$work" -name '*.o' | wc -l) files compiled, $((SECONDS - started)) s"
done
wait "$build" || { tail -n 30 "$work/log"; echo "The physics engine could not be built; its last lines are above. docker compose up --build needs no compiler."; exit 1; }
"$python" -m pip install --quiet --disable-pip-version-check --no-deps "$work"/wheels/*.whl
