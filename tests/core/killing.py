"""Program that runs commands of mphDRR one after the other, and kills some; torch is imported once for all of them.

Its argument is a list (JSON) of commands, each with the moment at which it is killed, a share of the seconds of the first
command, or null. It prints their statuses.
"""

import gc
import json
import os
import signal
import sys
import time

import openpyxl  # noqa: F401
import torch.utils.tensorboard  # noqa: F401

import mphdrr.core.learning.training  # noqa: F401
from mphdrr.core.cli import main
from mphdrr.tests.core.small_learning import add_toy

if __name__ == "__main__":
    add_toy()
    gc.freeze()  # what is imported is not looked at in each process
    statuses, seconds = [], []
    for words, moment in json.loads(sys.argv[1]):
        start = time.monotonic()
        if not (child := os.fork()):
            os._exit(main(words))
        if moment is not None:
            time.sleep(moment * seconds[0])
            os.kill(child, signal.SIGKILL)
        statuses.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        seconds.append(time.monotonic() - start)
    print(json.dumps(statuses))
