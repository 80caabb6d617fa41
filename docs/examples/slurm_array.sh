#!/bin/bash
# Divides a command over the machines of an array: each task does one part.
#   sbatch --array=0-15 slurm_array.sh data render MESHES --out DATA --size 512
# A task that failed is run again by the same line with --array=ITS NUMBER, and the number of all
# tasks: PARTS=16 sbatch --array=3 slurm_array.sh …
#SBATCH --job-name=gamba
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=8
#SBATCH --time=12:00:00
#SBATCH --requeue
set -euo pipefail

if [ $# -lt 2 ]; then
    echo "usage: sbatch --array=0-15 slurm_array.sh COMMAND … --out OUT [options]" >&2
    exit 2
fi
part=$SLURM_ARRAY_TASK_ID
parts=${PARTS:-$SLURM_ARRAY_TASK_COUNT}

srun gamba "$@" --shard "$part/$parts"
