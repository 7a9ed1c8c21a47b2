"""Headless Chromium on a page, spoken to through a pipe (Chrome DevTools Protocol)."""
from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import sys
import time

import cv2
import numpy as np

PROGRAM = next((p for p in map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))
                if p), None)
# WebGL without a graphics card; nothing that the browser asks for by itself.
OPTIONS = ('--headless=new', '--no-sandbox', '--use-angle=swiftshader', '--no-first-run',
           '--enable-unsafe-swiftshader', '--disable-dev-shm-usage', '--hide-scrollbars',
           '--disable-background-networking', '--remote-debugging-pipe')

# Chromium reads from 3 and writes to 4.
AS_3_AND_4 = """
import os, sys
os.dup2(int(sys.argv[1]), 3)
os.dup2(int(sys.argv[2]), 4)
os.execv(sys.argv[3], sys.argv[3:])
"""


class Browser:
    """One page; `requests` are the URLs that it asked for, `errors` what its scripts threw."""

    def __init__(self, profile, width=1100, height=900, timeout=60):
        self._until = time.monotonic() + timeout
        ours_in, theirs_out = os.pipe()
        theirs_in, ours_out = os.pipe()
        theirs = [fcntl.fcntl(end, fcntl.F_DUPFD, 100) for end in (theirs_in, theirs_out)]
        self._process = subprocess.Popen(
            [sys.executable, '-c', AS_3_AND_4, *map(str, theirs), PROGRAM, *OPTIONS,
             f'--window-size={width},{height}', f'--user-data-dir={profile}'],
            pass_fds=theirs, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for end in (theirs_in, theirs_out, *theirs):
            os.close(end)
        self._in, self._out, self._buffer = ours_in, ours_out, b''
        self._number, self._session = 0, None
        self.requests, self.errors, self.loaded = [], [], False
        target = self.call('Target.createTarget', url='about:blank')['targetId']
        self._session = self.call('Target.attachToTarget', targetId=target,
                                  flatten=True)['sessionId']
        for domain in ('Network', 'Page', 'Runtime', 'Log'):
            self.call(f'{domain}.enable')
        self.requests.clear()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.wait()
        os.close(self._in)
        os.close(self._out)

    def call(self, method, **params):
        self._number += 1
        message = {'id': self._number, 'method': method, 'params': params}
        if self._session:
            message['sessionId'] = self._session
        data = json.dumps(message).encode() + b'\0'
        while data:
            data = data[os.write(self._out, data):]
        while True:
            answer = self._next()
            if answer.get('id') == self._number:
                assert 'error' not in answer, answer
                return answer['result']

    def _next(self):
        while b'\0' not in self._buffer:
            left = self._until - time.monotonic()
            assert left > 0, 'the browser does not answer'
            if select.select([self._in], [], [], left)[0]:
                data = os.read(self._in, 1 << 20)
                assert data, 'the browser ended'
                self._buffer += data
        message, self._buffer = self._buffer.split(b'\0', 1)
        answer = json.loads(message)
        method, params = answer.get('method'), answer.get('params', {})
        if method == 'Network.requestWillBeSent':
            self.requests.append(params['request']['url'])
        elif method == 'Runtime.exceptionThrown':
            self.errors.append(params['exceptionDetails'].get('exception', {}).get('description'))
        elif method == 'Log.entryAdded' and params['entry']['level'] == 'error':
            self.errors.append(params['entry']['text'])
        elif method == 'Page.loadEventFired':
            self.loaded = True
        return answer

    def open(self, url):
        self.loaded = False
        self.call('Page.navigate', url=url)
        while not self.loaded:
            self._next()

    def value(self, expression):
        """What an expression of JavaScript gives; promises are awaited."""
        result = self.call('Runtime.evaluate', expression=expression, returnByValue=True,
                           awaitPromise=True)
        assert 'exceptionDetails' not in result, result
        return result['result'].get('value')

    def drag(self, begin, end):
        """With the left button, from one place of the window to another."""
        for kind, (x, y) in (('mousePressed', begin), ('mouseMoved', end),
                             ('mouseReleased', end)):
            self.call('Input.dispatchMouseEvent', type=kind, x=x, y=y, button='left', buttons=1,
                      clickCount=1)

    def box(self, selector):
        """Place of an element in the page: x, y, width, height."""
        return self.value(f'''(() => {{
            const box = document.querySelector({json.dumps(selector)}).getBoundingClientRect();
            return [box.x + scrollX, box.y + scrollY, box.width, box.height];
        }})()''')

    def picture(self, selector='body'):
        """BGR picture of an element."""
        x, y, width, height = self.box(selector)
        data = self.call('Page.captureScreenshot', captureBeyondViewport=True, clip={
            'x': x, 'y': y, 'width': width, 'height': height, 'scale': 1})['data']
        return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
