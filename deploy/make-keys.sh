#!/usr/bin/env bash
# Keys for mutual TLS: a CA for this fleet, made once, and a key with a certificate for each machine.
#
#   deploy/make-keys.sh DIR NAME [HOST|ADDRESS]...
#   deploy/make-keys.sh tls ground ground.example 192.0.2.1
#   deploy/make-keys.sh tls uav-1
#
# DIR/ca.key signs for the whole fleet: keep it off the machines. Each machine gets ca.pem, NAME.pem and NAME.key.
set -euo pipefail

if [ $# -lt 2 ]; then
  sed -n '2,8s/^# \{0,1\}//p' "$0" >&2
  exit 2
fi
dir=$1 name=$2
shift 2
umask 077
mkdir -p "$dir"

if [ ! -e "$dir/ca.key" ]; then
  openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 3650 -subj "/CN=hvt-ca" \
    -addext "basicConstraints=critical,CA:TRUE" -addext "keyUsage=critical,keyCertSign,cRLSign" \
    -keyout "$dir/ca.key" -out "$dir/ca.pem" 2>/dev/null
fi

# A listener is checked against the name or address that others connect to; a name of its own serves as identity.
names="DNS:$name"
for host in "$@"; do
  if [[ $host =~ ^[0-9.]+$ || $host == *:* ]]; then names+=",IP:$host"; else names+=",DNS:$host"; fi
done
openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj "/CN=$name" \
  -keyout "$dir/$name.key" -out "$dir/$name.csr" 2>/dev/null
openssl x509 -req -in "$dir/$name.csr" -CA "$dir/ca.pem" -CAkey "$dir/ca.key" -CAcreateserial -days 825 \
  -extfile <(printf 'subjectAltName=%s\nextendedKeyUsage=serverAuth,clientAuth\n' "$names") \
  -out "$dir/$name.pem" 2>/dev/null
rm "$dir/$name.csr"
echo "$dir/$name.pem $dir/$name.key for $names"
