"""Files and values that people write: TOML files, spans and sizes, the team file."""
