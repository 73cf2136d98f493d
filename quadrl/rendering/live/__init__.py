"""Fly and watch at the same time: in the browser, or in MuJoCo's own viewer."""
