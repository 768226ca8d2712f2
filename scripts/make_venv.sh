#!/bin/sh
# Makes a virtual environment with the first Python from 3.10 on that can: make_venv.sh FOLDER [PYTHON]
# Each candidate is run, not only looked up: a pyenv shim exists for versions that are not active,
# and Debian's python3 may come without ensurepip.
set -eu

folder=$1
wanted=${2:-}
check='import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 10))'

if [ -x "$folder/bin/python" ] &&
    "$folder/bin/python" -c 'import sys, pip; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then
    exit 0
fi

if [ -n "$wanted" ]; then
    candidates=$wanted
else
    candidates="python3 python3.13 python3.12 python3.11 python3.10 python3.14 python /usr/local/bin/python3 /usr/bin/python3"
    for version in "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.1[0-9]*; do
        if [ -x "$version/bin/python3" ]; then
            candidates="$candidates $version/bin/python3"
        fi
    done
fi

for python in $candidates; do
    if "$python" -c "$check" >/dev/null 2>&1; then
        echo "environment: $("$python" --version) in $folder"
        "$python" -m venv --clear "$folder"
        exit 0
    fi
done

echo "no Python from 3.10 on with venv and ensurepip among: $candidates" >&2
echo "install one (Debian: apt-get install python3 python3-venv) or say which: make PYTHON=/path/to/python3" >&2
exit 1
