#!/usr/bin/env bash
# Serves a Slurm cluster of one node, this host, from a folder until it is told to stop; tests start it.
#
#   scripts/slurm_node.sh FOLDER PORT PORT       then: SLURM_CONF=FOLDER/slurm.conf sinfo
#
# Partition `batch` is preempted (requeued) by partition `urgent`; `service` is left alone. Takes Debian's packages,
# and installs them when they are missing. Exit code 77: there is no Slurm, and none can be installed.
set -euo pipefail
folder=$1 controller_port=$2 node_port=$3

[ "$(id -u)" = 0 ] || { echo "Slurm starts jobs as their users, which takes root" >&2; exit 77; }
missing() { for name in slurmctld slurmd sbatch munged; do command -v "$name" >/dev/null || return 0; done; return 1; }
if missing; then
    command -v apt-get >/dev/null || { echo "no Slurm is installed" >&2; exit 77; }
    install() { DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends slurmctld slurmd slurm-client munge; }
    { install || { apt-get update -qq && install; }; } >/dev/null 2>&1 || true
    ! missing || { echo "slurmctld, slurmd and munge cannot be installed" >&2; exit 77; }
fi

mkdir -p "$folder"/{state,spool,munge}
chmod 711 "$folder" "$folder/munge"
(umask 077 && head -c 128 /dev/urandom >"$folder/munge/key")
host=$(hostname -s)
# The machine pretends to have processors enough. Requeued jobs wait until their old credentials have expired.
cat >"$folder/slurm.conf" <<CONF
ClusterName=planesweep
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=$controller_port
SlurmdPort=$node_port
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket=$folder/munge/socket,cred_expire=5
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmdParameters=config_overrides
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
SlurmctldParameters=preempt_send_user_signal
SchedulerParameters=batch_sched_delay=1,sched_interval=2,bf_interval=5
ReturnToService=2
MailProg=/bin/true
NodeName=$host NodeAddr=127.0.0.1 CPUs=4 RealMemory=1024 State=UNKNOWN
PartitionName=batch Nodes=ALL Default=YES PriorityTier=1 GraceTime=60
PartitionName=urgent Nodes=ALL PriorityTier=2
PartitionName=service Nodes=ALL PriorityTier=3 PreemptMode=OFF
CONF
export SLURM_CONF="$folder/slurm.conf"

daemons=()
trap 'kill "${daemons[@]}" 2>/dev/null; wait' EXIT
trap 'exit 0' TERM INT
munged --foreground --force --socket "$folder/munge/socket" --key-file "$folder/munge/key" \
    --pid-file "$folder/munge/pid" --seed-file "$folder/munge/seed" --log-file "$folder/munge/log" &
daemons+=($!)
until [ -S "$folder/munge/socket" ]; do sleep 0.1; kill -0 "${daemons[0]}"; done
slurmctld -D -L "$folder/slurmctld.log" &
daemons+=($!)
slurmd -D -L "$folder/slurmd.log" -N "$host" &
daemons+=($!)
# One that ends takes the others along.
wait -n
