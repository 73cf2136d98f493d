#!/usr/bin/env bash
# Trains what the page of results shows: hover with both engines and every aircraft, and the other tasks, each with its defaults.
# Then scripts/report training runs/training/*/* measures it. What is done is not trained again: docs/studies/training.sh
# Run it on a machine that does nothing else. The seeds were not used for tuning.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

# One after another, on all cores: their wall clock is compared.
for engine in free_flight mujoco; do
    for seed in {225..229}; do
        run="runs/training/hover-$engine/$seed"
        if [ ! -d "$run" ]; then
            quadrl train hover --engine "$engine" --seed "$seed" --no-video --out "$run"
        elif [ ! -f "$run/evaluation.json" ]; then
            quadrl train --resume "$run" --no-video
        fi
    done
done
for vehicle in crazyflie crazyflie_brushless hexa racer; do
    quadrl train hover --vehicle "$vehicle" --seeds 385:388 --out "runs/training/hover-$vehicle"
done
for task in static_waypoint random_waypoint straight_and_level landing target_following race recovery trajectory \
    perching deck_landing lsy_race navigation; do
    quadrl train "$task" --seeds 385:388 --out "runs/training/$task"
done
