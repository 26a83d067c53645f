#!/bin/sh
# Runs small_cl.c under oclgrind, which checks every memory access of the kernels and looks for data races, in the shape
# for GPUs and the one for CPUs:   sh tests/oclgrind.sh
# The last line is the sum: `N passed, N failed`. Environment: CC, CFLAGS.
here=$(cd "$(dirname "$0")" && pwd) || exit 1
tmp=$(mktemp -d) || exit 1
trap 'rm -rf "$tmp"' EXIT
passed=0 failed=0
# oclgrind knows neither what an optimizer nor what an inliner leaves behind
options="-cl-opt-disable -DTRB_OUTLINE"
for shape in 2 1; do
  ${CC:-cc} ${CFLAGS--std=c99 -O2} -DTRB_CL_SHAPE=$shape "$here/small_cl.c" -o "$tmp/small_cl" -lm -ldl || exit 1
  oclgrind --build-options "$options" --data-races "$tmp/small_cl" >"$tmp/out" 2>"$tmp/errors"
  status=$?
  summary=$(tail -n 1 "$tmp/out" | grep -E '^[0-9]+ passed, [0-9]+ failed$') || summary="0 passed, 1 failed"
  good=${summary%% *} bad=${summary#*, }
  bad=${bad%% *}
  if [ $status != 0 ] || [ -s "$tmp/errors" ]; then
    bad=$((bad + 1))
    cat "$tmp/out"
    head -n 40 "$tmp/errors"
  fi
  passed=$((passed + good)) failed=$((failed + bad))
done
echo "$passed passed, $failed failed"
[ "$failed" = 0 ]
