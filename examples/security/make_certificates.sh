#!/bin/sh
# Makes the certificates of one server and its clients with openssl: one folder for each, to be copied to its machine.
#
#   make_certificates.sh FOLDER server NAME[,NAME...]    the names and addresses that clients connect to
#   make_certificates.sh FOLDER client NAME...           the names that server.json5 gives rights to
#
# The first run makes the authority that signs them all; FOLDER/authority/ca.key makes more of them, so it stays
# where it is. A name that exists is given a new key and certificate. DAYS=365: how long they are valid.
set -eu
umask 077

usage() {
    sed -n 's/^# \{0,1\}//; 2,8p' "$0" >&2
    exit 2
}

[ $# -ge 3 ] || usage
folder=$1 kind=$2
shift 2
here=$(cd "$(dirname "$0")" && pwd)
days=${DAYS:-365}
mkdir -p "$folder/authority"
cd "$folder"

# openssl's own configuration differs between systems: this is all that is needed of one.
cat >authority/openssl.cnf <<'END'
[req]
distinguished_name = name
[name]
[authority]
basicConstraints = critical, CA:TRUE
keyUsage = critical, keyCertSign, cRLSign
subjectKeyIdentifier = hash
END

new_key() {
    openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out "$1" 2>/dev/null
}

authority() {
    [ ! -f authority/ca.pem ] || return 0
    new_key authority/ca.key
    openssl req -new -x509 -sha256 -days 3650 -key authority/ca.key -subj "/CN=crkr authority $(openssl rand -hex 4)" \
        -config authority/openssl.cnf -extensions authority -out authority/ca.pem
}

# sign FOLDER FILE NAME EXTENSIONS: FOLDER/FILE.key and FOLDER/FILE.pem, and what goes with them
sign() {
    mkdir -p "$1"
    new_key "$1/new.key"
    printf 'basicConstraints = critical, CA:FALSE\nkeyUsage = critical, digitalSignature\n%s\n' "$4" >authority/extensions
    openssl req -new -sha256 -key "$1/new.key" -subj "/CN=$3" -config authority/openssl.cnf -out authority/request
    openssl x509 -req -sha256 -days "$days" -in authority/request -CA authority/ca.pem -CAkey authority/ca.key \
        -set_serial "0x$(openssl rand -hex 15)" -extfile authority/extensions -out "$1/new.pem" 2>authority/messages ||
        { cat authority/messages >&2 && exit 1; }
    mv "$1/new.key" "$1/$2.key"
    mv "$1/new.pem" "$1/$2.pem"
    cp authority/ca.pem "$1/ca.pem"
    [ -f "$1/$2.json5" ] || cp "$here/$2.json5" "$1/$2.json5"
    echo "$folder/$1"
}

# alternatives NAME,...: the names as a certificate lists them
alternatives() {
    printf '%s\n' "$1" | tr ',' '\n' | while read -r name; do
        case $name in
        *:*) printf 'IP:%s,' "$name" ;;
        *[!0-9.]*) printf 'DNS:%s,' "$name" ;;
        *) printf 'IP:%s,' "$name" ;;
        esac
    done | sed 's/,$//'
}

authority
case $kind in
server)
    [ $# -eq 1 ] || usage
    sign server server server "extendedKeyUsage = serverAuth
subjectAltName = $(alternatives "$1")"
    ;;
client)
    for name; do
        case $name in *[!A-Za-z0-9._-]* | authority | server | -* | .* | '')
            echo "a client's name is made of letters, digits, '.', '_' and '-', and not authority or server; got '$name'" >&2
            exit 2
            ;;
        esac
        sign "$name" client "$name" "extendedKeyUsage = clientAuth"
    done
    ;;
*) usage ;;
esac
