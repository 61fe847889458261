"""The drift watch: has a camera moved since the rig was calibrated? (docs/drift.md)"""
