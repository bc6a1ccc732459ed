#!/bin/busybox sh
# First process of the VM, run from the initramfs. It brings up vcan0, mounts the host's folders under /host and runs
# the host's command there. When it fails before the command's exit code is sent, the kernel panics and QEMU ends.
set -e
/bin/busybox --install -s /bin
export PATH=/bin
mkdir -p /proc /sys /dev
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t devtmpfs devtmpfs /dev
for module in /modules/*.ko; do insmod "$module"; done

# The caches may be loose: while the VM runs, the host does not write into its writable folders.
share() { # tag, ro or rw, path on the host
    mkdir -p "/host$3"
    mount -t 9p -o "trans=virtio,version=9p2000.L,msize=512000,cache=loose,$2" "$1" "/host$3"
}
own() { # path, mode
    mount -t tmpfs -o "mode=$2" tmpfs "/host$1"
}
share root ro /
own /tmp 1777
own /run 755
[ -h /host/var/tmp ] || own /var/tmp 1777
mount -t proc proc /host/proc
mount -t sysfs sysfs /host/sys
mount -t devtmpfs devtmpfs /host/dev
mkdir -p /dev/pts /dev/shm
mount -t devpts devpts /host/dev/pts
own /dev/shm 1777
ln -s /proc/self/fd /dev/fd
ln -s /proc/self/fd/0 /dev/stdin
ln -s /proc/self/fd/1 /dev/stdout
ln -s /proc/self/fd/2 /dev/stderr
while read -r tag mode path; do share "$tag" "$mode" "$path"; done </job/shares

ip link set lo up
ip link add dev vcan0 type vcan
ip link set vcan0 mtu 72 up # 72: flexible data rate
hostname salient-vm

# The ports show up a moment after their driver.
for port in 1 2 3; do
    tries=0
    until [ -c /dev/vport0p$port ]; do
        tries=$((tries + 1))
        [ $tries -lt 500 ]
        usleep 10000
    done
done
# A port opens only once; through a pipe the command can open /dev/stdout as on the host.
mkfifo /out /err
cat </out >/dev/vport0p1 &
out=$!
cat </err >/dev/vport0p2 &
err=$!

cp /job/command.sh /host/run/command.sh
code=0
chroot /host /bin/sh /run/command.sh </dev/null >/out 2>/err || code=$?

# Processes that the command left running would keep the pipes open.
for process in /proc/[0-9]*; do
    case " 1 $out $err " in
    *" ${process#/proc/} "*) ;;
    *) kill -9 "${process#/proc/}" 2>/dev/null || true ;;
    esac
done
wait "$out" "$err"
sync
echo "$code" >/dev/vport0p3
reboot -f
