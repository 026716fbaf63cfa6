"""The Roman Space Telescope's Wide Field Instrument."""
