#!/usr/bin/env bash
# What the pictures and the browser test need besides the Python packages of the `test` extra: Debian's Chromium, which
# draws the rerun viewer on its software renderer, and Mesa's software Vulkan, on which the native viewer draws without
# a screen. For Debian and Ubuntu; needs root or sudo.
set -euo pipefail
as_root=()
[ "$(id -u)" -eq 0 ] || as_root=(sudo)
"${as_root[@]}" apt-get update
"${as_root[@]}" apt-get install --yes --no-install-recommends chromium mesa-vulkan-drivers
