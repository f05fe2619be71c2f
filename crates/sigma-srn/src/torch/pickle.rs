//! Pickles of protocol 2, as `torch.save` writes them, read without running anything: a pickle is a program for a machine with a stack,
//! and the only calls that this machine knows make dictionaries and tensors.

use std::collections::HashMap;
use std::io::Read;

/// Bytes of a pickle at most: a network of ten thousand tensors has a tenth of it.
const LONGEST: u64 = 4 << 20;
/// Bytes of a name at most: many entries may share one.
const LONGEST_NAME: usize = 1000;
/// Dimensions of a tensor at most.
const MOST_DIMENSIONS: usize = 8;

/// Number of a value in [`Pickle::values`]. Values refer to each other by number, so that nothing is ever copied and no file, whatever
/// it nests, shares or loops, costs more memory than its length in opcodes.
pub type Id = usize;

/// A tensor's place in its storage.
#[derive(Debug)]
pub struct TensorAt {
    /// Where its values are.
    pub storage: Storage,
    /// First value.
    pub offset: usize,
    /// Values along each dimension.
    pub shape: Vec<usize>,
    /// Values of the storage from one index to the next, for each dimension.
    pub strides: Vec<usize>,
}

/// A block of numbers outside the pickle.
#[derive(Clone, Copy, Debug)]
pub struct Storage {
    /// Name of the type, such as `FloatStorage`: number of a [`Value::Global`].
    pub class: Id,
    /// Name of the block: number of a [`Value::Text`].
    pub key: Id,
    /// Number of values.
    pub len: usize,
}

/// What a pickle holds, as far as a checkpoint needs it.
#[derive(Debug)]
pub enum Value {
    None,
    Int(i64),
    Text(String),
    Tuple(Vec<Id>),
    List(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    /// A class or function by its name, without the module.
    Global(String),
    Storage(Storage),
    Tensor(TensorAt),
    /// A boolean, a real number or a large integer: optimizers have them.
    Other,
}

/// All values of a pickle.
#[derive(Debug)]
pub struct Pickle {
    values: Vec<Value>,
    /// The outermost value.
    pub root: Id,
}

impl Pickle {
    pub fn value(&self, id: Id) -> &Value {
        &self.values[id]
    }

    /// The text of a value that is one, and no longer than names are.
    pub fn name(&self, id: Id) -> Option<&str> {
        match self.value(id) {
            Value::Text(text) if text.len() <= LONGEST_NAME => Some(text),
            _ => None,
        }
    }

    /// Entries of a dictionary whose keys are names.
    pub fn entries(&self, id: Id) -> Option<impl Iterator<Item = (&str, Id)>> {
        match self.value(id) {
            Value::Dict(entries) => Some(entries.iter().filter_map(|&(key, value)| Some((self.name(key)?, value)))),
            _ => None,
        }
    }

    /// Key and class of every storage.
    pub fn storages(&self) -> impl Iterator<Item = (&str, &str)> {
        self.values.iter().filter_map(|value| match value {
            Value::Storage(storage) => Some((self.name(storage.key)?, self.class(storage)?)),
            _ => None,
        })
    }

    /// The class of a storage.
    pub fn class(&self, storage: &Storage) -> Option<&str> {
        match self.value(storage.class) {
            Value::Global(class) => Some(class),
            _ => None,
        }
    }

    /// Reads one pickle and leaves the reader behind it. An error says at which byte of the pickle.
    pub fn read(reader: impl Read) -> Result<Self, String> {
        let mut machine =
            Machine { reader: reader.take(LONGEST), values: vec![], stack: vec![], marks: vec![], memo: HashMap::new() };
        loop {
            let at = LONGEST - machine.reader.limit();
            let step = machine.step().map_err(|what| format!("pickle, byte {at}: {what}"));
            if let Some(root) = step? {
                return Ok(Pickle { values: machine.values, root });
            }
        }
    }
}

struct Machine<R> {
    reader: std::io::Take<R>,
    values: Vec<Value>,
    stack: Vec<Id>,
    /// Heights of the stack where marks were set.
    marks: Vec<usize>,
    memo: HashMap<u32, Id>,
}

impl<R: Read> Machine<R> {
    /// Obeys one opcode; returns the result at the last.
    fn step(&mut self) -> Result<Option<Id>, String> {
        match self.byte()? {
            0x80 => match self.byte()? {
                2 => {}
                protocol => return Err(format!("protocol {protocol} instead of torch.save's 2")),
            },
            b'.' => return self.pop().map(Some),
            b'(' => self.marks.push(self.stack.len()),
            b'N' => self.push(Value::None),
            0x88 | 0x89 => self.push(Value::Other),
            b'K' => {
                let value = self.byte()?;
                self.push(Value::Int(value.into()));
            }
            b'M' => {
                let value = u16::from_le_bytes(self.bytes()?);
                self.push(Value::Int(value.into()));
            }
            b'J' => {
                let value = i32::from_le_bytes(self.bytes()?);
                self.push(Value::Int(value.into()));
            }
            0x8a => self.long()?,
            b'G' => {
                self.bytes::<8>()?;
                self.push(Value::Other);
            }
            b'X' => {
                let length = u32::from_le_bytes(self.bytes()?);
                let text = self.text(length)?;
                self.push(Value::Text(text));
            }
            b')' => self.push(Value::Tuple(vec![])),
            code @ 0x85..=0x87 => self.tuple(usize::from(code - 0x84))?,
            b't' => {
                let items = self.pop_to_mark()?;
                self.push(Value::Tuple(items));
            }
            b']' => self.push(Value::List(vec![])),
            b'a' => {
                let item = self.pop()?;
                self.append(vec![item])?;
            }
            b'e' => {
                let items = self.pop_to_mark()?;
                self.append(items)?;
            }
            b'}' => self.push(Value::Dict(vec![])),
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.set(&[key, value])?;
            }
            b'u' => {
                let items = self.pop_to_mark()?;
                self.set(&items)?;
            }
            b'q' => {
                let place = self.byte()?;
                self.memo.insert(place.into(), self.top()?);
            }
            b'r' => {
                let place = u32::from_le_bytes(self.bytes()?);
                self.memo.insert(place, self.top()?);
            }
            b'h' => {
                let place = self.byte()?;
                self.recall(place.into())?;
            }
            b'j' => {
                let place = u32::from_le_bytes(self.bytes()?);
                self.recall(place)?;
            }
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.global(module, name)?;
            }
            b'Q' => {
                let id = self.pop()?;
                let storage = self.storage(id)?;
                self.push(Value::Storage(storage));
            }
            b'R' => {
                let (arguments, function) = (self.pop()?, self.pop()?);
                self.call(function, arguments)?;
            }
            // Attributes of an object. Dictionaries of weights have one, the versions of their modules; nothing here needs it.
            b'b' => {
                self.pop()?;
                let object = self.top()?;
                if !matches!(self.values[object], Value::Dict(_)) {
                    return Err("attributes of something that is no dictionary".into());
                }
            }
            code => return Err(format!("opcode {code:#04x}, which no checkpoint needs")),
        }
        Ok(None)
    }

    fn byte(&mut self) -> Result<u8, String> {
        Ok(self.bytes::<1>()?[0])
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let mut bytes = [0; N];
        match self.reader.read_exact(&mut bytes) {
            Ok(()) => Ok(bytes),
            Err(_) if self.reader.limit() < N as u64 => Err(format!("longer than {LONGEST} bytes")),
            Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => Err("ends too early".into()),
            Err(error) => Err(error.to_string()),
        }
    }

    fn text(&mut self, length: u32) -> Result<String, String> {
        let mut bytes = Vec::new();
        self.reader.by_ref().take(length.into()).read_to_end(&mut bytes).map_err(|error| error.to_string())?;
        if bytes.len() < length as usize {
            return Err("ends too early".into());
        }
        String::from_utf8(bytes).map_err(|_| "a text that is not UTF-8".into())
    }

    fn line(&mut self) -> Result<String, String> {
        let mut bytes = Vec::new();
        loop {
            match self.byte()? {
                b'\n' => return String::from_utf8(bytes).map_err(|_| "a name that is not UTF-8".into()),
                byte => bytes.push(byte),
            }
        }
    }

    /// An integer of any length, lowest byte first, in two's complement.
    fn long(&mut self) -> Result<(), String> {
        let count = self.byte()?;
        let bytes = (0..count).map(|_| self.byte()).collect::<Result<Vec<u8>, String>>()?;
        let mut padded = [if bytes.last().is_some_and(|&last| last >= 0x80) { 0xff } else { 0 }; 8];
        self.push(if bytes.len() > padded.len() {
            Value::Other
        } else {
            padded[..bytes.len()].copy_from_slice(&bytes);
            Value::Int(i64::from_le_bytes(padded))
        });
        Ok(())
    }

    fn push(&mut self, value: Value) {
        self.values.push(value);
        self.stack.push(self.values.len() - 1);
    }

    fn top(&self) -> Result<Id, String> {
        let floor = self.marks.last().copied().unwrap_or(0);
        self.stack[floor..].last().copied().ok_or_else(|| "nothing on the stack".into())
    }

    fn pop(&mut self) -> Result<Id, String> {
        let top = self.top()?;
        self.stack.pop();
        Ok(top)
    }

    fn pop_to_mark(&mut self) -> Result<Vec<Id>, String> {
        let mark = self.marks.pop().ok_or("no mark on the stack")?;
        Ok(self.stack.split_off(mark))
    }

    fn tuple(&mut self, count: usize) -> Result<(), String> {
        let mut items = (0..count).map(|_| self.pop()).collect::<Result<Vec<Id>, String>>()?;
        items.reverse();
        self.push(Value::Tuple(items));
        Ok(())
    }

    fn append(&mut self, items: Vec<Id>) -> Result<(), String> {
        let list = self.top()?;
        match &mut self.values[list] {
            Value::List(list) => list.extend(items),
            _ => return Err("appends to something that is no list".into()),
        }
        Ok(())
    }

    fn set(&mut self, items: &[Id]) -> Result<(), String> {
        let dict = self.top()?;
        match &mut self.values[dict] {
            Value::Dict(_) if !items.len().is_multiple_of(2) => return Err("a key without a value".into()),
            Value::Dict(entries) => entries.extend(items.chunks_exact(2).map(|pair| (pair[0], pair[1]))),
            _ => return Err("sets an entry of something that is no dictionary".into()),
        }
        Ok(())
    }

    fn recall(&mut self, place: u32) -> Result<(), String> {
        let id = *self.memo.get(&place).ok_or_else(|| format!("nothing was remembered as {place}"))?;
        self.stack.push(id);
        Ok(())
    }

    /// A class or function by name; whatever is not needed is refused here, called or not.
    fn global(&mut self, module: String, name: String) -> Result<(), String> {
        match (module.as_str(), name.as_str()) {
            ("collections", "OrderedDict") | ("torch._utils", "_rebuild_tensor_v2" | "_rebuild_parameter") => {}
            ("torch", storage) if storage.ends_with("Storage") => {}
            _ => {
                let what = "is neither a dictionary nor a tensor, and nothing else is read; to keep the weights alone, in Python";
                let (module, name) = (module.escape_debug(), name.escape_debug());
                return Err(format!("`{module}.{name}` {what}: torch.save({{'model': checkpoint['model']}}, 'weights.pth')"));
            }
        }
        self.push(Value::Global(name));
        Ok(())
    }

    fn call(&mut self, function: Id, arguments: Id) -> Result<(), String> {
        let (Value::Global(name), Value::Tuple(items)) = (&self.values[function], &self.values[arguments]) else {
            return Err("calls something that is no function".into());
        };
        match (name.as_str(), items.as_slice()) {
            ("OrderedDict", []) => self.push(Value::Dict(vec![])),
            ("_rebuild_tensor_v2", &[storage, offset, shape, strides, ..]) => {
                let Value::Storage(storage) = self.values[storage] else { return Err("a tensor without a storage".into()) };
                let tensor =
                    TensorAt { storage, offset: self.size(offset)?, shape: self.sizes(shape)?, strides: self.sizes(strides)? };
                if tensor.shape.len() != tensor.strides.len() {
                    return Err(format!("a tensor with {} sizes and {} strides", tensor.shape.len(), tensor.strides.len()));
                }
                self.push(Value::Tensor(tensor));
            }
            ("_rebuild_parameter", &[tensor, ..]) if matches!(self.values[tensor], Value::Tensor(_)) => self.stack.push(tensor),
            (name, items) => return Err(format!("`{name}` with {} arguments that it does not take", items.len())),
        }
        Ok(())
    }

    fn size(&self, id: Id) -> Result<usize, String> {
        match self.values[id] {
            Value::Int(size) => size.try_into().map_err(|_| format!("{size} where a size must be")),
            _ => Err("no number where a size must be".into()),
        }
    }

    fn sizes(&self, id: Id) -> Result<Vec<usize>, String> {
        match &self.values[id] {
            Value::Tuple(items) if items.len() <= MOST_DIMENSIONS => items.iter().map(|&item| self.size(item)).collect(),
            Value::Tuple(items) => Err(format!("a tensor of {} dimensions", items.len())),
            _ => Err("no tuple where sizes must be".into()),
        }
    }

    /// `('storage', class, key, device, length)`; the format before 1.6 adds what part of it is meant, today always `None`: all.
    fn storage(&self, id: Id) -> Result<Storage, String> {
        let Value::Tuple(items) = &self.values[id] else { return Err("a reference that is no tuple".into()) };
        let is_view = |id: &Id| !matches!(self.values[*id], Value::None);
        match items.as_slice() {
            &[kind, class, key, _, len, ref view @ ..] => match (&self.values[kind], &self.values[class], &self.values[key]) {
                (Value::Text(kind), Value::Global(_), Value::Text(_)) if kind == "storage" && !view.iter().any(is_view) => {
                    Ok(Storage { class, key, len: self.size(len)? })
                }
                _ => Err("a reference to something that is no whole storage".into()),
            },
            items => Err(format!("a reference of {} parts", items.len())),
        }
    }
}

/// A pickle of `{'model': OrderedDict of tensors}`; tensor `k` is the whole of storage `k`.
pub fn write(tensors: &[(String, Vec<usize>, &[f32])]) -> Vec<u8> {
    const NEW_DICT: &[u8] = b"ccollections\nOrderedDict\n)R";
    let mut out = Vec::new();
    out.extend(b"\x80\x02}");
    text(&mut out, "model");
    out.extend(NEW_DICT);
    out.push(b'(');
    for (key, (name, shape, values)) in tensors.iter().enumerate() {
        text(&mut out, name);
        out.extend(b"ctorch._utils\n_rebuild_tensor_v2\n((");
        text(&mut out, "storage");
        out.extend(b"ctorch\nFloatStorage\n");
        text(&mut out, &key.to_string());
        text(&mut out, "cpu");
        integer(&mut out, values.len());
        out.extend(b"tQ");
        integer(&mut out, 0);
        let stride = |k: usize| shape[k + 1..].iter().product();
        tuple(&mut out, shape.iter().copied());
        tuple(&mut out, (0..shape.len()).map(stride));
        // No gradient, no hooks.
        out.push(0x89);
        out.extend(NEW_DICT);
        out.extend(b"tR");
    }
    out.extend(b"us.");
    out
}

fn text(out: &mut Vec<u8>, text: &str) {
    out.push(b'X');
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}

/// An integer of eight bytes; the highest is never negative, no tensor is that large.
fn integer(out: &mut Vec<u8>, value: usize) {
    out.extend([0x8a, 8]);
    out.extend((value as u64).to_le_bytes());
}

fn tuple(out: &mut Vec<u8>, values: impl Iterator<Item = usize>) {
    out.push(b'(');
    values.for_each(|value| integer(out, value));
    out.push(b't');
}
