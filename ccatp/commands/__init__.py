"""The commands of ``ccatp``, one file each; ``ccatp.cli`` gathers them."""
