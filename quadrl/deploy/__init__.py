"""What carries a policy elsewhere: the page that flies in the browser."""
