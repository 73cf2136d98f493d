"""The command `scripts/report NAME`."""

import tyro

from scripts.reports.any_aircraft import any_aircraft, any_memories
from scripts.reports.crosscheck import crosschecks
from scripts.reports.flights import flights
from scripts.reports.forest import forest, rays
from scripts.reports.measure import speed, training
from scripts.reports.one_policy import one_policy
from scripts.reports.pages import pages
from scripts.reports.pictures import pictures
from scripts.reports.robustness import robust, robustness
from scripts.reports.shipping import renew, ship, shipped
from scripts.reports.world import world

REPORTS = (
    training,
    speed,
    robust,
    robustness,
    flights,
    forest,
    rays,
    crosschecks,
    any_aircraft,
    any_memories,
    one_policy,
    world,
    ship,
    shipped,
    renew,
    pictures,
    pages,
)

if __name__ == "__main__":
    commands = {each.__name__: each for each in REPORTS}
    tyro.extras.subcommand_cli_from_dict(commands, prog="scripts/report")
