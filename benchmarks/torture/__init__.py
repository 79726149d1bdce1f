"""The long harms: what faults, floods and hostile files cost, measured and written down."""
