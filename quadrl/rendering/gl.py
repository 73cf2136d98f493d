"""The graphics library: which one draws, and how it gets along with dm_control.

mujoco and dm_control choose theirs at import, and without a screen take GLFW, which then fails,
unless `MUJOCO_GL` is set. Here a machine without a screen gets EGL at its first picture, for
mujoco.Renderer and, after `choose`, for dm_control as well.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import os
import sys
import warnings
from collections.abc import Generator
from typing import Any

import mujoco

from quadrl.base.errors import RenderingUnavailable
from quadrl.base.shield import refuse_after_fork

GL_RENDERER = 0x1F01
SOFTWARE = (b"llvmpipe", b"softpipe", b"swrast", b"swiftshader", b"software")


def choose() -> None:
    """Let dm_control draw without a screen; call it before dm_control is imported, or after.

    Where dm_control would use GLFW, its renderer becomes one that opens EGL at the first picture.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # GLFW's, about the missing screen
        render: Any = importlib.import_module("dm_control._render")
    if _without_screen() and render.BACKEND == "glfw":
        render.Renderer, render.BACKEND = _dm_control_context, "egl"


def open_renderer(
    model: mujoco.MjModel, width: int, height: int, max_geom: int, fine: bool = True
) -> mujoco.Renderer:
    """MuJoCo's renderer for pictures of a model.

    Args:
        model: What is drawn.
        width: Width of the pictures [pixels].
        height: Height of the pictures [pixels].
        max_geom: Most shapes in a picture.
        fine: With the smooth edges and the shadows that the model asks for, or without.

    Raises:
        RenderingUnavailable: There is no graphics library to draw with.
    """
    quality = model.vis.quality
    asked = quality.offsamples, quality.shadowsize
    with _failure_named():
        _set_up()
        try:
            if not fine:
                quality.offsamples = quality.shadowsize = 0
            with current_context_kept():
                return mujoco.Renderer(model, height, width, max_geom)
        finally:
            quality.offsamples, quality.shadowsize = asked


@functools.cache
def drawn_by_processor() -> bool:
    """Whether a processor does the work of a graphics card here, as Mesa's llvmpipe does.

    Raises:
        RenderingUnavailable: There is no graphics library to draw with.
    """
    with _failure_named():
        _set_up()
        with current_context_kept():
            context = sys.modules[mujoco.Renderer.__module__].gl_context.GLContext(1, 1)
            try:
                context.make_current()
                name = importlib.import_module("OpenGL.GL").glGetString(GL_RENDERER) or b""
            finally:
                context.free()
    return any(software in name.lower() for software in SOFTWARE)


def _set_up() -> None:
    """Choose what mujoco.Renderer asks for its contexts."""
    if _without_screen():
        chosen: Any = importlib.import_module("mujoco.egl")
        sys.modules[mujoco.Renderer.__module__].gl_context.GLContext = chosen.GLContext
    egl: Any = sys.modules.get("mujoco.egl")
    if egl and egl.EGL_DISPLAY is None:
        # mujoco would open it itself, and close it at exit: dm_control, which shares the display,
        # could then no longer free its own contexts.
        display = egl.create_initialized_egl_device_display()
        egl.EGL_DISPLAY = display if display != egl.EGL.EGL_NO_DISPLAY else None


def close(renderer: mujoco.Renderer) -> None:
    """Free a renderer and its context."""
    context = renderer._gl_context
    try:
        with current_context_kept():
            context.make_current()  # MuJoCo frees what belongs to the current context
            renderer.close()
    except Exception:  # at exit dm_control may have closed the display, and all in it, before
        context._context = None


@contextlib.contextmanager
def current_context_kept() -> Generator[None]:
    """Give the thread back the EGL context that it had.

    dm_control makes its context current only once; without this it would go on to draw in ours.

    Raises:
        RenderingUnavailable: As `refuse_after_fork` says.
    """
    refuse_after_fork()
    egl: Any = sys.modules.get("mujoco.egl")
    before = egl and egl.EGL_DISPLAY and egl.EGL.eglGetCurrentContext()
    try:
        yield
    finally:
        if egl and egl.EGL_DISPLAY:
            context, none = before or egl.EGL.EGL_NO_CONTEXT, egl.EGL.EGL_NO_SURFACE
            egl.EGL.eglMakeCurrent(egl.EGL_DISPLAY, none, none, context)


def _without_screen() -> bool:
    names = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    return sys.platform == "linux" and not any(os.environ.get(name) for name in names)


def _dm_control_context(max_width: int, max_height: int) -> Any:
    """A context of dm_control's own kind."""
    with _failure_named():
        egl: Any = importlib.import_module("dm_control._render.pyopengl.egl_renderer")
        return egl.EGLContext(max_width, max_height)


@contextlib.contextmanager
def _failure_named() -> Generator[None]:
    refuse_after_fork()
    try:
        yield
    except Exception as error:  # each platform fails in its own way
        raise RenderingUnavailable(
            "no OpenGL context is available, so nothing can be drawn; simulation and training work "
            f"without one. On Debian: apt install libegl1 libgl1-mesa-dri. It failed with: {error}"
        ) from error
