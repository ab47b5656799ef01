#!/usr/bin/env bash
# Writes src/occfusion/assets/web_player.js.gz from player.js, @sparkjsdev/spark and three, and for the tests
# tests/oracles/gltf_by_three.js.gz from gltf_reader.js and three. Needs node and npm.
set -euo pipefail
cd "$(dirname "$0")"
npm install --no-audit --no-fund
npx esbuild player.js --bundle --minify --format=iife --legal-comments=none --outfile=build/web_player.js
gzip -9 -n -c build/web_player.js > ../../src/occfusion/assets/web_player.js.gz
npx esbuild gltf_reader.js --bundle --minify --format=iife --legal-comments=none --outfile=build/gltf_reader.js
gzip -9 -n -c build/gltf_reader.js > ../../tests/oracles/gltf_by_three.js.gz
