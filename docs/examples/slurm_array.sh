#!/bin/bash
# Divides a command over the machines of an array: each task does one part.
#   sbatch --array=0-15 slurm_array.sh data render MESHES --out DATA --size 512
#   sbatch --array=0-7 --gpus=1 slurm_array.sh eval-views --checkpoint MODEL --data DATA --out EVAL
#   sbatch --array=0-7 slurm_array.sh eval-geometry PRED TRUTHS --out EVAL
# Evaluations write EVAL/0, EVAL/1, …; afterwards: gamba eval-join EVAL/[0-9]* --out EVAL/all
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
words=()
# A report has a folder for each part; objects of "data render" are in one folder.
for word in "$@"; do
    if [[ $1 == eval-* && ${#words[@]} -gt 0 && ${words[-1]} == --out ]]; then
        word=$word/$part
    fi
    words+=("$word")
done

srun gamba "${words[@]}" --shard "$part/$parts"
