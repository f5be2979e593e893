"""Ed25519 signatures of certificates and sessions.

signatures    signatures of bytes
keys          the key of the bench, and files of trusted public keys
certificates  certificates with a signature

A signature shows which key wrote a file, and that no byte of it was changed since. It is made wherever the
bench has a key, and needs the package cryptography (``imu50[sign]``).
"""
