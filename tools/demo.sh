#!/bin/sh
# make demo: a live run on the simulated rig, its re-run compared byte for byte, a picture.
# Usage: demo.sh BIN SECONDS, with BIN the directory that holds the command `vibrissa`.
set -eu
bin=$1
seconds=$2

number=1
while [ -e "runs/demo-$number" ]; do number=$((number + 1)); done
run=runs/demo-$number

if [ "$(nproc)" -lt 4 ]; then
    echo "== live run, $seconds s, placed for $(nproc) cores by docs/examples/two_cores.toml"
    "$bin/vibrissa" run docs/examples/two_cores.toml --duration "$seconds" --out "$run"
else
    echo "== live run, $seconds s"
    "$bin/vibrissa" run --duration "$seconds" --out "$run"
fi
echo "== the same run again from its log, in one process"
"$bin/vibrissa" verify "$run"
echo "== and again over real processes and sockets"
"$bin/vibrissa" verify "$run" --executor lockstep
echo "== picture"
"$bin/vibrissa" plot "$run"
echo
echo "log      $run/run.mcap      (vibrissa info $run)"
echo "summary  $run/summary.json"
echo "picture  $run/run.png"
