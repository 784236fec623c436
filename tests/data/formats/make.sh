#!/bin/sh
# Made the files of this folder from gsply_plain.ply (see make_gsply_files.py), with two other programs, both MIT:
# @playcanvas/splat-transform 2.7.1 and @mkkellogg/gaussian-splats-3d 0.4.7. The tests need neither.
set -e
cd "$(dirname "$0")"
npm install --no-save @playcanvas/splat-transform@2.7.1 @mkkellogg/gaussian-splats-3d@0.4.7 three
convert="npx splat-transform -q -w -g cpu ../gsply_plain.ply"
$convert v4.spz
npx splat-transform -q -w --spz-version 3 ../gsply_plain.ply v3.spz
$convert v2.sog
$convert plain.glb
for level in 0 1 2; do node make_ksplat.mjs ../gsply_plain.ply level$level.ksplat $level 2; done
rm -r node_modules
