"""What agent, server and calibration must agree on: types, bytes on the wire, file formats."""
