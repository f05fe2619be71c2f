//! In a browser: the page opens the device, errors of a call are known some time after it, at the latest when something is read, and waiting suspends
//! what runs.

use std::sync::mpsc;

use js_sys::Promise;
use js_sys::futures::spawn_local;
use js_sys::wasm_bindgen::JsValue;

use super::{Gpu, lock, open_scopes, told};

impl Gpu {
    /// Whether it can be told how long a kernel takes: in a browser only by the device's own clock.
    pub(crate) fn can_time(&self) -> bool {
        self.device.features().contains(wgpu::Features::TIMESTAMP_QUERY)
    }

    /// Does `work`; what goes wrong is not known yet, and told to who asks next.
    pub(super) fn scoped<T>(&self, work: impl FnOnce() -> T) -> (T, Vec<wgpu::Error>) {
        let scopes = open_scopes(&self.device);
        let value = work();
        for scope in scopes.into_iter().rev() {
            let (popped, shared) = (scope.pop(), self.shared.clone());
            spawn_local(async move {
                if let Some(error) = popped.await {
                    lock(&shared.uncaptured).get_or_insert(told(&error));
                }
            });
        }
        (value, Vec::new())
    }

    /// Suspends until all work submitted so far is done and `buffer` is there to be read. The page must have come here through an export
    /// with `#[wasm_bindgen(jspi)]`.
    pub(super) fn map(&self, buffer: &wgpu::Buffer) -> Result<(), String> {
        let (sender, receiver) = mpsc::channel();
        let mapped = Promise::new(&mut |resolve, _| {
            let sender = sender.clone();
            buffer.slice(..).map_async(wgpu::MapMode::Read, move |result| {
                drop(sender.send(result));
                drop(resolve.call0(&JsValue::UNDEFINED));
            });
        });
        #[expect(deprecated, reason = "a mark for what is new, not for what is old")]
        let waited = js_sys::futures::jspi_block_on_promise(&mapped);
        match (waited, receiver.try_recv()) {
            (Ok(_), Ok(Ok(()))) => Ok(()),
            _ => Err("the device was lost, or the buffer cannot be mapped".into()),
        }
    }
}
