#!/bin/sh
# Print the first interpreter that can make our virtual environment; PYTHON overrides the search.
# Being on the PATH is not enough: version managers leave stubs, distributions leave out venv.
check='import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))'
for python in ${PYTHON:-python3.11 python3.12 python3 python3.13 python3.14 python}; do
    if "$python" -c "$check" >/dev/null 2>&1; then
        echo "$python"
        exit 0
    fi
done
echo "no Python 3.11 or later with the venv module among: ${PYTHON:-python3.11 python3.12 python3 python}" \
    "(set PYTHON=/path/to/python; Debian and Ubuntu: apt install python3-venv)" >&2
exit 1
