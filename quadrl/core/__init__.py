"""Tasks and the environment that flies them: one pure step of rows, under every API."""
