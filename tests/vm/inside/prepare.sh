#!/bin/sh
# Runs in the new root directory while the image is built: kernel module, Python environment, what a Pi has, then
# everything goes that only building needs.
set -eu
export DEBIAN_FRONTEND=noninteractive PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore

kernel=$(ls /lib/modules)
make -C "/lib/modules/$kernel/build" M=/tmp/vm modules
install -D /tmp/vm/sxmock.ko "/lib/modules/$kernel/extra/sxmock.ko"
depmod "$kernel"

python3 -m venv /opt/tsgt
/opt/tsgt/bin/pip install --quiet --no-index --find-links /tmp/vm/wheels --requirement /tmp/vm/requirements.txt

install -m 644 /tmp/vm/agent.py /usr/local/lib/agent.py
install -m 644 /tmp/vm/agent.service /etc/systemd/system/agent.service
systemctl enable agent.service
systemctl mask apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer fstrim.timer e2scrub_all.timer \
    e2scrub_reap.service systemd-tpm2-setup-early.service systemd-tpm2-setup.service getty@tty1.service \
    systemd-binfmt.service sys-kernel-tracing.mount sys-kernel-debug.mount dev-mqueue.mount dev-hugepages.mount

# As on Raspberry Pi OS.
groupadd --force --system spi
groupadd --force --system gpio
cat > /etc/udev/rules.d/99-com.rules <<'RULES'
SUBSYSTEM=="spidev", GROUP="spi", MODE="0660"
SUBSYSTEM=="gpio", GROUP="gpio", MODE="0660"
RULES

echo vm > /etc/hostname
echo '127.0.0.1 localhost vm' > /etc/hosts
printf '/dev/vda / ext4 errors=remount-ro 0 1\n' > /etc/fstab
passwd --delete root
mkdir -p /etc/systemd/journald.conf.d
printf '[Journal]\nStorage=persistent\n' > /etc/systemd/journald.conf.d/persistent.conf
mkdir -p /var/log/journal
systemd-machine-id-setup

# A small initial file system: only what reaches the disk.
printf 'MODULES=list\nCOMPRESS=zstd\nCOMPRESSLEVEL=1\n' > /etc/initramfs-tools/conf.d/vm
printf 'virtio_pci\nvirtio_blk\next4\n' >> /etc/initramfs-tools/modules
update-initramfs -u -k "$kernel"

apt-get purge --quiet --quiet --yes --autoremove $PURGE
rm -rf /tmp/vm /var/lib/apt/lists/* /var/cache/apt/* /usr/share/doc/* /usr/share/man/* /usr/share/locale/*
