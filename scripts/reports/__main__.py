"""The command `scripts/report NAME`."""

import tyro

from scripts.reports.measure import speed, training
from scripts.reports.pages import pages
from scripts.reports.pictures import pictures
from scripts.reports.robustness import robust, robustness
from scripts.reports.shipping import renew, ship, shipped

REPORTS = (training, speed, robust, robustness, ship, shipped, renew, pictures, pages)

if __name__ == "__main__":
    commands = {each.__name__: each for each in REPORTS}
    tyro.extras.subcommand_cli_from_dict(commands, prog="scripts/report")
