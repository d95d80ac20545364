#!/usr/bin/env bash
# Installs a headless Chromium with WebGL 2 from npm (versions pinned by package-lock.json) and prints the path to start
# it by. Usage: export FACEDIFF_CHROMIUM=$(tools/browser/install.sh FOLDER). Needs Node 20.11 or newer; 270 MB.
set -euo pipefail
source=$(cd "$(dirname "$0")" && pwd)
folder=$(mkdir -p "$1/chromium" && cd "$1" && pwd)

cp "$source/package.json" "$source/package-lock.json" "$source/unpack.mjs" "$folder"
cd "$folder"
npm ci --ignore-scripts --no-audit --no-fund --loglevel=error >&2
TMPDIR="$folder/chromium" node unpack.mjs
