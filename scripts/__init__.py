"""The scripts of this repository; nothing in here is shipped."""
