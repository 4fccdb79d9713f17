"""What several tests share: small birds, files, footage and networks."""
