#!/usr/bin/env bash
# Installs a headless Chromium with WebGL 2 from npm (versions pinned by package-lock.json) and prints the path to start
# it by. Usage: export FACEDIFF_CHROMIUM=$(tools/browser/install.sh FOLDER). Needs Node 20.11 or newer; 290 MB. Puts npm's
# package of ONNX Runtime for browsers next to it, which the tests of `facediff serve` need.
set -euo pipefail
source=$(cd "$(dirname "$0")" && pwd)
folder=$(mkdir -p "$1/chromium" && cd "$1" && pwd)

cp "$source/package.json" "$source/package-lock.json" "$source/unpack.mjs" "$folder"
cd "$folder"
npm ci --ignore-scripts --no-audit --no-fund --loglevel=error >&2
version=$(sed -n 's/^VERSION = "\(.*\)"$/\1/p' "$source/../../facediff/runtime/onnxruntime_web.py")
npm pack --ignore-scripts --silent "onnxruntime-web@$version" >&2
TMPDIR="$folder/chromium" node unpack.mjs
