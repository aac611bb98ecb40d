#!/bin/sh
# Certificates for agents that authenticate each other by TLS: an authority in DIR/ca, and DIR/NAME.{crt,key} for each agent.
#     certificates.sh DIR cav1=10.0.0.1 rsu1=10.0.0.2
# The private key of the authority, DIR/ca.key, stays where this ran; an agent's machine gets ca.crt and its own two files.
set -eu
umask 077
[ $# -ge 2 ] || { echo "usage: $0 DIR NAME=ADDRESS..." >&2; exit 2; }
dir=$1
shift
mkdir -p "$dir"
days=825

key() { openssl ecparam -name prime256v1 -genkey -noout -out "$1"; }

if [ ! -e "$dir/ca.key" ]; then
    key "$dir/ca.key"
    openssl req -x509 -new -key "$dir/ca.key" -days $days -subj "/CN=realo" -out "$dir/ca.crt" \
        -addext "basicConstraints=critical,CA:TRUE" -addext "keyUsage=critical,keyCertSign"
fi
for agent in "$@"; do
    name=${agent%%=*}
    address=${agent#*=}
    case $address in
    *[!0-9.:]*) alternative=DNS:$address ;;
    *) alternative=IP:$address ;;
    esac
    key "$dir/$name.key"
    openssl req -new -key "$dir/$name.key" -subj "/CN=$name" -out "$dir/$name.csr"
    printf '%s\n' "subjectAltName=$alternative" "extendedKeyUsage=serverAuth,clientAuth" "basicConstraints=CA:FALSE" > "$dir/$name.ext"
    openssl x509 -req -in "$dir/$name.csr" -CA "$dir/ca.crt" -CAkey "$dir/ca.key" -CAcreateserial -days $days \
        -extfile "$dir/$name.ext" -out "$dir/$name.crt"
    rm "$dir/$name.csr" "$dir/$name.ext"
done
