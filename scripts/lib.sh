# shellcheck shell=bash
# What the scripts share: the environment in .venv. To be sourced; needs bash 3.2 or later.

REPOSITORY="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
ENVIRONMENT="$REPOSITORY/.venv"
ENVIRONMENT_PYTHON="$ENVIRONMENT/bin/python"
# First line: the fingerprint of what was installed. Second line: the extras.
STAMP="$ENVIRONMENT/quadrl-environment"
# Python: ends with 0 in a version that constraints.txt is for.
SUPPORTED='import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))'

say() { printf 'quadrl: %s\n' "$*" >&2; }

die() {
    say "$*"
    exit 1
}

# may_install WHAT: says what is about to be installed and how to prevent it; fails where QUADRL_INSTALL=no does.
may_install() {
    [ "${QUADRL_INSTALL:-yes}" != no ] || return 1
    say "installing $* (QUADRL_INSTALL=no prevents it)"
}

# install_packages NAME...: with apt-get where this user may, never with sudo; fails without a word where not.
install_packages() {
    [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null || return 1
    may_install "with apt-get, as root: $*" || return 1
    apt-get update -qq >&2 &&
        DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >&2
}

# find_python: prints the command of a Python that quadrl is tested with; $PYTHON overrules the choice.
find_python() {
    local candidate candidates=(python3 python3.13 python3.12 python3.11 python)
    [ -z "${PYTHON:-}" ] || candidates=("$PYTHON")
    for candidate in "${candidates[@]}"; do
        if "$candidate" -c "$SUPPORTED" 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    [ -z "${PYTHON:-}" ] || die "PYTHON=$PYTHON is not a Python 3.11, 3.12 or 3.13"
    die "needs Python 3.11, 3.12 or 3.13, and found $(python3 --version 2>/dev/null || echo none)." \
        "Install one, or name it: PYTHON=/path/to/python3.13 $0"
}

# has_compiler: whether the C compiler that quadrl.native will pick makes a shared library; C's headers belong to it.
has_compiler() {
    local compiler library works=1
    compiler="$(command -v ${CC:+"$CC"} cc gcc clang | head -n 1)"
    library="$(mktemp)"
    printf '#include <math.h>\ndouble f(double x) { return sqrt(x); }\n' |
        "${compiler:-false}" -shared -fPIC -x c -o "$library" - 2>/dev/null && works=0
    rm -f "$library"
    return "$works"
}

# ensure_compiler: the rotor callbacks are compiled against the installed mujoco at their first use.
ensure_compiler() {
    has_compiler && return
    install_packages build-essential && has_compiler && return
    case "$(uname -s)" in
        Darwin) die "needs a C compiler: run 'xcode-select --install'" ;;
        *) die "needs a C compiler: install 'build-essential' (Debian, Ubuntu) or 'gcc' (Fedora, Arch)" ;;
    esac
}

draws_without_screen() {
    MUJOCO_GL=egl "$ENVIRONMENT_PYTHON" -c 'import mujoco; mujoco.GLContext(64, 64).free()' >/dev/null 2>&1
}

# ensure_renderer: EGL draws the pictures where there is no screen. Nothing else depends on it.
ensure_renderer() {
    local packages=(libegl1 libgl1 libgl1-mesa-dri)
    [ "$(uname -s)" = Linux ] || return 0
    [ -z "${DISPLAY:-}${WAYLAND_DISPLAY:-}" ] && [ "${MUJOCO_GL:-egl}" = egl ] || return 0
    draws_without_screen && return
    if ! dpkg -s "${packages[@]}" >/dev/null 2>&1; then
        install_packages "${packages[@]}" && draws_without_screen && return
    fi
    say "no EGL here: pictures and video are left out; simulation and training work." \
        "For pictures install ${packages[*]} (Debian, Ubuntu)" \
        "or mesa-libEGL mesa-libGL mesa-dri-drivers (Fedora)."
}

# ensure_web: emcc, which compiles C to WebAssembly; and node and Chromium, which the tests of the page run.
ensure_web() {
    local command missing=()
    for command in emcc:emscripten node:nodejs chromium:chromium; do
        command -v "${command%%:*}" >/dev/null || missing+=("${command##*:}")
    done
    [ "${#missing[@]}" -eq 0 ] && return
    install_packages "${missing[@]}" && return
    command -v emcc >/dev/null ||
        die "needs emcc to compile C to WebAssembly: install 'emscripten' (Debian, Ubuntu, Fedora, Homebrew)"
    say "not here: ${missing[*]}; the page is built, and its tests are skipped"
}

# ensure_board: compilers for boards and emulated ones, on which the slow tests run policies in C.
ensure_board() {
    local tool missing=""
    for tool in arm-none-eabi-gcc qemu-system-arm aarch64-linux-gnu-gcc qemu-aarch64; do
        command -v "$tool" >/dev/null || missing="$missing $tool"
    done
    [ -z "$missing" ] ||
        install_packages gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm \
            gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user ||
        say "there is no$missing here: the tests on emulated boards are skipped"
}

make_venv() {
    local python
    python="$(find_python)"
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        local package
        package="$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')"
        install_packages "$package" || die "$python cannot make environments: install '$package' (Debian, Ubuntu)"
    fi
    say "making the environment $ENVIRONMENT"
    "$python" -m venv "$ENVIRONMENT"
}

# ensure_environment EXTRA...: quadrl, editable, with these extras and the versions of constraints.txt in .venv.
# Without a stamp that says so, pip goes over it again: that completes what an interrupted run left behind.
ensure_environment() {
    local extra installed wanted
    ensure_compiler
    [ -f "$ENVIRONMENT/pyvenv.cfg" ] || make_venv
    "$ENVIRONMENT_PYTHON" -c "import pip; $SUPPORTED" 2>/dev/null ||
        die "$ENVIRONMENT has no Python 3.11, 3.12 or 3.13 that works: remove it and run again"
    installed="$(sed -n 2p "$STAMP" 2>/dev/null || true)"
    for extra in "$@"; do
        case " $installed " in
            *" $extra "*) ;;
            *) installed="${installed:+$installed }$extra" ;;
        esac
    done
    # A fingerprint, which changes with anything that the environment is made from, and the extras.
    wanted="$(cd "$REPOSITORY" && { pwd && cat pyproject.toml constraints.txt; } | cksum; echo "$installed")"
    if [ "$(cat "$STAMP" 2>/dev/null)" != "$wanted" ]; then
        installed="${installed:+[${installed// /,}]}"
        may_install "quadrl$installed into $ENVIRONMENT: at first minutes and, with torch, gigabytes" ||
            die "needs quadrl$installed in $ENVIRONMENT, and QUADRL_INSTALL=no: run again without it"
        "$ENVIRONMENT_PYTHON" -m pip install --disable-pip-version-check \
            --constraint "$REPOSITORY/constraints.txt" --editable "$REPOSITORY$installed" >&2
        echo "$wanted" >"$STAMP"
    fi
    ensure_renderer
}
