#!/bin/bash
# Makes or extends a keystore in the layout of SROS2, with openssl alone: a CA, governance, and an enclave for each name.
#
#   launch-scripts/keystore.sh KEYSTORE ENCLAVE[=TOPIC,TOPIC…] …
#
#   launch-scripts/keystore.sh keys /cell /camera=rt/image,rt/image/compressed
#   ROS_SECURITY_ENABLE=true ROS_SECURITY_STRATEGY=Enforce ROS_SECURITY_KEYSTORE=keys \
#       target/release/capture_node --ros-args --enclave /cell
#
# An enclave may publish and subscribe every topic, or, where topics are given, those and what every ROS node needs. Topics have
# their names on DDS: rt/ before a topic, rq/…Request and rr/…Reply for a service; * and ? as in file names.
# Environment: DAYS, how long certificates hold (3650).
set -euo pipefail
[ $# -ge 2 ] || { sed -n '2,/^set/s/^# \{0,1\}//p' "$0" | head -n -1; exit 2; }
keystore=$1
shift
days=${DAYS:-3650}
command -v openssl >/dev/null || { echo "$0: openssl is missing" >&2; exit 2; }
umask 077
mkdir -p "$keystore"/{public,private,enclaves}
keystore=$(cd "$keystore" && pwd)

# PKCS #8, which not every DDS takes other forms than.
key() { openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:prime256v1 -out "$1" 2>/dev/null; }
sign() {
    openssl smime -sign -text -in "$1" -out "$2" -signer "$keystore/public/ca.cert.pem" \
        -inkey "$keystore/private/ca.key.pem" 2>/dev/null
}

# --- the CA, which signs identities and permissions -------------------------------------------------------------------
if [ ! -f "$keystore/private/ca.key.pem" ]; then
    key "$keystore/private/ca.key.pem"
    openssl req -x509 -new -key "$keystore/private/ca.key.pem" -sha256 -days "$days" -subj "/CN=sros2CA" \
        -out "$keystore/public/ca.cert.pem"
    for role in identity permissions; do
        ln -sf ca.cert.pem "$keystore/public/${role}_ca.cert.pem"
        ln -sf ca.key.pem "$keystore/private/${role}_ca.key.pem"
    done
fi

# --- what holds for everybody: nobody without a certificate, everything encrypted ---------------------------------------
# Whole submessages are encrypted, data with what is said of it. Data are not encrypted once more by themselves: RustDDS
# can't read again what it has cut into fragments after that.
if [ ! -f "$keystore/enclaves/governance.p7s" ]; then
    cat >"$keystore/enclaves/governance.xml" <<'XML'
<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:noNamespaceSchemaLocation="http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_governance.xsd">
  <domain_access_rules>
    <domain_rule>
      <domains><id_range><min>0</min><max>232</max></id_range></domains>
      <allow_unauthenticated_participants>false</allow_unauthenticated_participants>
      <enable_join_access_control>true</enable_join_access_control>
      <discovery_protection_kind>ENCRYPT</discovery_protection_kind>
      <liveliness_protection_kind>ENCRYPT</liveliness_protection_kind>
      <rtps_protection_kind>SIGN</rtps_protection_kind>
      <topic_access_rules>
        <topic_rule>
          <topic_expression>*</topic_expression>
          <enable_discovery_protection>true</enable_discovery_protection>
          <enable_liveliness_protection>true</enable_liveliness_protection>
          <enable_read_access_control>true</enable_read_access_control>
          <enable_write_access_control>true</enable_write_access_control>
          <metadata_protection_kind>ENCRYPT</metadata_protection_kind>
          <data_protection_kind>NONE</data_protection_kind>
        </topic_rule>
      </topic_access_rules>
    </domain_rule>
  </domain_access_rules>
</dds>
XML
    sign "$keystore/enclaves/governance.xml" "$keystore/enclaves/governance.p7s"
fi

# --- the enclaves -----------------------------------------------------------------------------------------------------
topic_list() { printf '<topic>%s</topic>' "$@"; }
for enclave in "$@"; do
    name=/${enclave%%=*}
    name=/${name##*//}
    name=/${name#/}
    case $name/ in */../* | */./* | *//?*) echo "$0: enclave '$name': a path of names" >&2; exit 2 ;; esac
    topics=(\*)
    if [[ $enclave == *=* ]]; then
        IFS=, read -r -a topics <<<"${enclave#*=}"
        # Of every ROS node: the graph, log lines, parameters and lifecycle, health, the clock.
        topics+=(ros_discovery_info rt/rosout rt/parameter_events rt/diagnostics rt/clock "rt/*/transition_event"
            "rq/*parameter*Request" "rr/*parameter*Reply" "rq/*_state*Request" "rr/*_state*Reply"
            "rq/*_transition*Request" "rr/*_transition*Reply")
    fi
    folder=$keystore/enclaves$name
    mkdir -p "$folder"
    [ -f "$folder/key.pem" ] || key "$folder/key.pem"
    openssl req -new -key "$folder/key.pem" -subj "/CN=$(sed 's#/#\\/#g' <<<"$name")" -out "$folder/cert.csr"
    openssl x509 -req -in "$folder/cert.csr" -sha256 -days "$days" -CA "$keystore/public/ca.cert.pem" \
        -CAkey "$keystore/private/ca.key.pem" -set_serial "0x$(openssl rand -hex 16)" -out "$folder/cert.pem" 2>/dev/null
    rm "$folder/cert.csr"
    cat >"$folder/permissions.xml" <<XML
<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:noNamespaceSchemaLocation="http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_permissions.xsd">
  <permissions>
    <grant name="$name">
      <subject_name>CN=$name</subject_name>
      <validity><not_before>$(date -u -d '1 day ago' +%FT%T)</not_before><not_after>$(date -u -d "$days days" +%FT%T)</not_after></validity>
      <allow_rule>
        <domains><id_range><min>0</min><max>232</max></id_range></domains>
        <publish><topics>$(topic_list "${topics[@]}")</topics></publish>
        <subscribe><topics>$(topic_list "${topics[@]}")</topics></subscribe>
      </allow_rule>
      <default>DENY</default>
    </grant>
  </permissions>
</dds>
XML
    sign "$folder/permissions.xml" "$folder/permissions.p7s"
    for role in identity permissions; do cp "$keystore/public/ca.cert.pem" "$folder/${role}_ca.cert.pem"; done
    cp "$keystore/enclaves/governance.p7s" "$folder/governance.p7s"
    echo "$folder"
done
