"""Where the method fails and what it must not depend on, measured: `lightprobe bench stability`."""
