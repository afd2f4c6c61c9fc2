#!/usr/bin/env bash
# Builds the physics engine's pinned source with the virtual environment $1, where there is no wheel of it for this
# Python. It takes about four minutes on two cores, so it says how far it is. numpy must be there already, or the
# engine is built without arrays, and hands over pictures pixel by pixel.
set -euo pipefail
venv=$1 python=$1/bin/python
[ "$("$python" -c 'import sys; print(sys.version_info[:2] == (3, 11))')" = True ] && exit
pinned() { sed -n "/^$1==/,/[^\\\\]\$/p" requirements.lock; }
wanted=$(pinned pybullet | sed -n 's/^pybullet==\([^ ]*\).*/\1/p')
"$python" -c "
from importlib.metadata import version
import pybullet
assert version('pybullet') == '$wanted' and pybullet.isNumpyEnabled()" >/dev/null 2>&1 && exit

work=$(mktemp -d) build=
# Jobs of a script are not told of Ctrl-C, and a compiler that is left alone goes on: the build is a group to end.
trap '[ -z "$build" ] || kill -- "-$build" 2>/dev/null || true; rm -rf "$work"' EXIT
(pinned numpy && pinned setuptools) >"$work/tools.lock"
pinned pybullet >"$work/engine.lock"
"$python" -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r "$work/tools.lock"
echo "Building the physics engine from source, once for this Python (about four minutes on two cores) ..."
set -m
TMPDIR=$work "$python" -m pip wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation --no-binary pybullet \
  --require-hashes -r "$work/engine.lock" -w "$work/wheels" </dev/null >"$work/log" 2>&1 &
build=$!
set +m
started=$SECONDS
while sleep 10 && kill -0 "$build" 2>/dev/null; do
  echo "  $(find "$work" -name '*.o' 2>/dev/null | wc -l) of about 270 files compiled, $((SECONDS - started)) s"
done
wait "$build" || { tail -n 30 "$work/log"; echo "The physics engine could not be built; its last lines are above. docker compose up --build needs no compiler."; exit 1; }
build=
"$python" -m pip install --quiet --disable-pip-version-check --no-deps "$work"/wheels/*.whl
