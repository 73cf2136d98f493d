"""Policies in C on a processor of boards: an STM32F405 (Cortex-M4), which QEMU emulates."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from quadrl.deploy.export import export

BOARD = Path(__file__).parents[1] / "board"
TOOLS = "arm-none-eabi-gcc", "qemu-system-arm", "arm-none-eabi-size"
COMPANION = "aarch64-linux-gnu-gcc", "qemu-aarch64"


def needed(tools, packages):
    there = all(map(shutil.which, tools))
    return pytest.mark.skipif(not there, reason=f"apt-get install {packages}")


on_board = needed(TOOLS, "gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm")
FLAGS = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-std=c11",
         "-ffp-contract=off", "-Wall", "-Werror", "-Wno-unused-function", "-nostartfiles",
         "--specs=nosys.specs", f"-T{BOARD / 'board.ld'}", str(BOARD / "board.c"))  # fmt: skip
PROGRAM = """#include "{header}"
#include "{board}/board.h"
static {name}_memory memory;
static {name}_motion now;
int main(void) {{
  float action[{upper}_ACTIONS], command[{upper}_COMMANDS];
  now.quaternion[0] = 1;
  if ({name}_begin(&memory, &now, NULL) || {name}_step(&memory, &now, action, command)) return 2;
  begin_count();
  if ({name}_step(&memory, &now, action, command)) return 3;
  say_count();
  return {name}_test();
}}
"""


def flown(header, name, folder, optimisation):
    """What the test of a header gives on the board, and the instructions of a step."""
    source, made = folder / "main.c", folder / "main.elf"
    given = {"header": header, "board": BOARD, "name": name, "upper": name.upper()}
    source.write_text(PROGRAM.format(**given))
    command = [TOOLS[0], *FLAGS, optimisation, source, "-o", made, "-lm"]
    subprocess.run(command, check=True, capture_output=True, text=True)
    machine = ["-machine", "netduinoplus2", "-nographic", "-semihosting", "-icount", "shift=0"]
    run = [TOOLS[1], *machine, "-kernel", made]
    done = subprocess.run(run, capture_output=True, text=True, timeout=60)
    return done.returncode, int(done.stdout + done.stderr)


@on_board
@pytest.mark.parametrize("optimisation", ["-O2", "-O3"])
@pytest.mark.parametrize(
    ("policy", "name", "most"),
    [
        ("hover_ppo", "hover", 25_000),
        ("hover_robust", "hover_robust", 45_000),
        ("random_waypoint_robust_crazyflie_brushless", "random_waypoint_robust", 45_000),
        ("race_apg", "race", 45_000),
        ("target_following_robust", "target_following_robust", 45_000),
        ("landing_robust", "landing_robust", 45_000),
        ("lsy_race_ppo", "lsy_race", 45_000),
        ("trajectory_ppo", "trajectory", 70_000),
        ("navigation_ppo", "navigation", 100_000),
    ],
)
def test_a_board_has_the_bits_of_the_reference(policy, name, most, optimisation, tmp_path):
    """And the header's estimates are right: of the program, which is hardly more, too."""
    header = export(policy, "c", tmp_path / "policy.h")
    wrong, instructions = flown(header, name, tmp_path, optimisation)
    assert wrong == 0 and 1_000 < instructions <= most
    said = re.search(r"^// ([\d,]+) instructions .*; (\d+) kB of flash", header.read_text(), re.M)
    assert instructions == pytest.approx(int(said[1].replace(",", "")), rel=0.05)
    sizes = subprocess.run([TOOLS[2], tmp_path / "main.elf"], capture_output=True, text=True)
    assert int(sizes.stdout.split("\n")[1].split()[0]) == pytest.approx(1e3 * int(said[2]), rel=0.1)


@on_board
def test_a_wrong_number_is_seen_on_a_board(tmp_path):
    header = export("hover", "c", tmp_path / "policy.h")
    header.write_text(header.read_text().replace("a * over", "1.001f * a * over"))
    assert flown(header, "hover", tmp_path, "-O2")[0] == 1


@needed(COMPANION, "gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user")
@pytest.mark.parametrize("optimisation", ["-O0", "-O2", "-O3"])
@pytest.mark.parametrize("policy", ["hover_robust", "trajectory", "lsy_race"])
def test_a_companion_computer_has_the_bits_of_the_reference(policy, optimisation, tmp_path):
    """A 64-bit ARM, which QEMU emulates."""
    header = export(policy, "c", tmp_path / "policy.h")
    source, made = tmp_path / "main.c", tmp_path / "main"
    source.write_text(f'#include "{header}"\nint main(void) {{ return {policy}_test(); }}\n')
    flags = "-std=c99", "-ffp-contract=off", "-static", optimisation
    subprocess.run([COMPANION[0], *flags, source, "-o", made, "-lm"], check=True)
    assert subprocess.run([COMPANION[1], made]).returncode == 0
    source.write_text(source.read_text().replace("_test()", "_test() == 0"))
    subprocess.run([COMPANION[0], *flags, source, "-o", made, "-lm"], check=True)
    assert subprocess.run([COMPANION[1], made]).returncode == 1  # so it was run


FIRMWARE = os.environ.get("CRAZYFLIE_FIRMWARE", "")


@on_board
@pytest.mark.skipif(not FIRMWARE, reason="CRAZYFLIE_FIRMWARE names no checkout of the firmware")
def test_the_firmware_of_a_crazyflie_is_built_with_a_policy_in_it(tmp_path):
    app = export("hover_robust_crazyflie_brushless", "crazyflie", tmp_path / "app")
    named = {"PWD": str(app), "CRAZYFLIE_BASE": FIRMWARE}
    for goal in ("cf21bl_defconfig", "all"):
        command = ["make", f"CRAZYFLIE_BASE={FIRMWARE}", goal]
        done = subprocess.run(command, cwd=app, env=os.environ | named, capture_output=True)
        assert done.returncode == 0, done.stderr.decode()[-2000:]
    made = (app / "build" / "cf21bl.bin").read_bytes()
    assert 300_000 < len(made) < 1_032_192  # of its flash
    assert b"quadrl" in made  # the group of the controller's parameters
