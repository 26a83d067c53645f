#!/bin/sh
# Builds and runs each project in this folder the way a user of trbvh would, in a temporary folder:
#   sh tests/consumer/run.sh
here=$(cd "$(dirname "$0")" && pwd) || exit 1
root=$(cd "$here/../.." && pwd)
tmp=$(mktemp -d) || exit 1
trap 'rm -rf "$tmp"' EXIT
passed=0 failed=0

have() { command -v "$1" >/dev/null 2>&1; }
macro() { sed -n "s/^#define TRBVH_VERSION_$1 *//p" "$root/trbvh.h"; }
version=$(macro MAJOR).$(macro MINOR).$(macro PATCH)

# check FUNCTION: its output is shown only on failure
check() {
  if "$1" >"$tmp/log" 2>&1; then
    passed=$((passed + 1))
  else
    cat "$tmp/log"
    echo "FAILED consumer/$1"
    failed=$((failed + 1))
  fi
}

# configure_and_build PROJECT CMAKE_OPTIONS
configure_and_build() {
  project=$1
  shift
  cmake -S "$here/$project" -B "$tmp/$project" "$@" &&
  cmake --build "$tmp/$project" &&
  test "$("$tmp/$project/consumer")" = "$version" &&
  test "$("$tmp/$project/consumer_cl")" = "$version"
}
cmake_subdir() { configure_and_build cmake_subdir -DTRBVH_FOLDER="$root"; }
install_and_move() {   # the installed files must not know where they were installed
  cmake -S "$root" -B "$tmp/trbvh" -DTRBVH_BUILD_TESTS=OFF -DTRBVH_BUILD_EXAMPLES=OFF \
    -DCMAKE_INSTALL_PREFIX="$tmp/first" &&
  cmake --install "$tmp/trbvh" &&
  mv "$tmp/first" "$tmp/prefix"
}
cmake_installed() {
  configure_and_build cmake_installed -DCMAKE_PREFIX_PATH="$tmp/prefix" -DVERSION_WANTED="$version"
}
other_version_is_refused() {
  ! cmake -S "$here/cmake_installed" -B "$tmp/other" -DCMAKE_PREFIX_PATH="$tmp/prefix" -DVERSION_WANTED=999.0
}
pkgconfig() {
  export PKG_CONFIG_PATH="$tmp/prefix/share/pkgconfig"
  test "$(pkg-config --modversion trbvh)" = "$version" &&
  cp -r "$here/." "$tmp/consumer" &&
  make -C "$tmp/consumer/pkgconfig" &&
  test "$("$tmp/consumer/pkgconfig/consumer")" = "$version"
}

if have cmake; then
  check cmake_subdir
  check install_and_move
  check cmake_installed
  check other_version_is_refused
  if have pkg-config && have make; then
    check pkgconfig
  else
    echo "left out: consumer/pkgconfig (needs pkg-config and make)"
  fi
else
  echo "left out: consumer (cmake is not installed)"
fi
echo "$passed passed, $failed failed"
[ "$failed" = 0 ]
