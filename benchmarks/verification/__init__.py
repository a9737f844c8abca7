"""The verification suite: warpfem against closed forms, manufactured and independent high-order solutions."""
