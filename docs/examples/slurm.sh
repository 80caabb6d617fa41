#!/bin/bash
# Trains on 2 machines with 8 GPUs each: sbatch slurm.sh DATA RUN [options of gamba train]
# With shards (gamba data pack): sbatch slurm.sh SHARDS RUN
# The same command goes on from the newest checkpoint, also after the time is up.
#SBATCH --job-name=gamba
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --gpus-per-node=8
#SBATCH --cpus-per-task=64
#SBATCH --time=24:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=TERM@120
# --requeue: Slurm starts the job again where a machine fails. --signal: two minutes before the end
# the processes get SIGTERM, save a checkpoint and stop.
set -euo pipefail

if [ $# -lt 2 ]; then
    echo "usage: sbatch slurm.sh DATA RUN [options of gamba train]" >&2
    exit 2
fi
data=$1
run=$2
shift 2

first=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | sed -n 1p)
port=$((20000 + SLURM_JOB_ID % 20000))

srun --kill-on-bad-exit=1 torchrun \
    --nnodes "$SLURM_NNODES" --nproc-per-node 8 --max-restarts 10 \
    --rdzv-id "$SLURM_JOB_ID" --rdzv-backend c10d --rdzv-endpoint "$first:$port" \
    -m gamba_warp.train "$data" --out "$run" --recipe paper \
    --activation-checkpointing --workers 8 "$@"
