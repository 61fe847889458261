"""`rig-agent --check`: looks at everything that streaming needs here, and says what mends it."""
