#!/bin/sh
# make_disk.sh DEBIAN.tar SIZE "PACKAGES TO PURGE": makes image/ of the archive and of vm/, in the current folder. It runs in
# a mount namespace of its own.
set -e
mkdir root
tar --extract --numeric-owner --file "$1" --directory root
cp -r vm root/tmp/vm
mount -t proc proc root/proc
PURGE="$3" chroot root sh /tmp/vm/prepare.sh
umount root/proc
cp -L root/boot/vmlinuz-* image/vmlinuz
cp -L root/boot/initrd.img-* image/initrd.img
chmod 644 image/*
mke2fs -q -t ext4 -L root -d root image/root.img "$2"
rm -rf root
