#!/usr/bin/env bash
# Writes src/occfusion/assets/web_player.js.gz from player.js, @sparkjsdev/spark and three. Needs node and npm.
set -euo pipefail
cd "$(dirname "$0")"
npm install --no-audit --no-fund
npx esbuild player.js --bundle --minify --format=iife --legal-comments=none --outfile=build/web_player.js
gzip -9 -n -c build/web_player.js > ../../src/occfusion/assets/web_player.js.gz
